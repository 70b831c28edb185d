"""Free memory in a container."""

from pathlib import Path

import pytest

from egovcp import hardware

GB = 1 << 30


def test_the_page_cache_of_a_container_counts_as_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    meminfo, group = tmp_path / "meminfo", tmp_path / "cgroup"
    meminfo.write_text(f"MemAvailable: {64 * GB // 1024} kB\n")
    group.mkdir()
    (group / "memory.max").write_text(f"{4 * GB}\n")
    (group / "memory.current").write_text(f"{3 * GB}\n")
    (group / "memory.stat").write_text(f"anon {GB}\ninactive_file {2 * GB}\n")
    monkeypatch.setattr(hardware, "_MEMINFO", meminfo)
    monkeypatch.setattr(hardware, "_CGROUP", group)
    assert hardware.available_bytes() == 3 * GB
    (group / "memory.max").write_text("max\n")
    assert hardware.available_bytes() == 64 * GB
