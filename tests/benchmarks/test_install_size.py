"""Sizes are those of the files of all required distributions."""

import install_size
import pytest


@pytest.mark.parametrize(
    ("name", "part"),
    [
        *((name, True) for name in ("torch", "triton", "nvidia-cublas", "cuda-toolkit")),
        *((name, False) for name in ("torchvision", "torchcodec", "tritonclient", "numpy")),
    ],
)
def test_distributions_of_torch_are_matched_by_their_whole_name(name: str, part: bool) -> None:
    assert bool(install_size._TORCH.fullmatch(name)) == part


@pytest.mark.slow
def test_an_application_is_larger_than_the_library_and_torch_is_left_out() -> None:
    sizes = install_size.sizes_mb()
    assert sizes["egovcp-experiment_mb"] > sizes["egovcp_mb"] > 500
    assert sizes["egovcp_without_torch_mb"] < 0.5 * sizes["egovcp_mb"]
