"""The installation script."""

import shutil
import subprocess
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[1] / "install.sh"


def test_without_python_3_12_it_says_so_and_exits_with_5(tmp_path: Path) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    for name in ("bash", "dirname"):
        found = shutil.which(name)
        assert found is not None
        (programs / name).symlink_to(found)
    for name in ("python3", "python3.12"):  # another version, and a shim that runs nothing
        (programs / name).write_text("#!/bin/bash\nexit 1\n")
        (programs / name).chmod(0o755)
    script = Path(shutil.copy(SCRIPT, tmp_path))
    done = subprocess.run(
        [script],
        env={"PATH": str(programs), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 5
    assert done.stderr.splitlines() == [
        "install: error: no Python 3.12 found (lerobot needs it); "
        "install it or set PYTHON=/path/to/python3.12"
    ]
