"""Sizes are those of the files of all required distributions."""

import runpy
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks/install_size.py"


@pytest.mark.slow
def test_an_application_is_larger_than_the_library_and_torch_is_left_out() -> None:
    script = runpy.run_path(str(SCRIPT))
    sizes = script["sizes_mb"]()
    assert sizes["egovcp-experiment_mb"] > sizes["egovcp_mb"] > 500
    assert sizes["egovcp_without_torch_mb"] < 0.5 * sizes["egovcp_mb"]
