"""Import rules between packages."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {
    "egovcp": ROOT / "egovcp",
    "egovcp_collect": ROOT / "collect" / "egovcp_collect",
    "egovcp_train": ROOT / "train" / "egovcp_train",
    "egovcp_deploy": ROOT / "deploy" / "egovcp_deploy",
    "egovcp_experiment": ROOT / "experiment" / "egovcp_experiment",
    "lerobot_env_egovcp": ROOT / "plugins" / "lerobot_env_egovcp" / "lerobot_env_egovcp",
    "lerobot_policy_egovcp": ROOT / "plugins" / "lerobot_policy_egovcp" / "lerobot_policy_egovcp",
    "lerobot_robot_egovcp": ROOT / "plugins" / "lerobot_robot_egovcp" / "lerobot_robot_egovcp",
}

#: What a package may import besides the library and itself: a plugin is a view of an application.
ALLOWED = {"lerobot_robot_egovcp": ("egovcp_deploy",)}

#: Part of the library -> what it must not import, anywhere in its files.
FORBIDDEN = {
    "egovcp/model": (
        *("egovcp.data", "egovcp.robot", "egovcp.sim", "egovcp.plan", "egovcp.log"),
        *("mujoco", "lerobot"),
    ),
    "egovcp/plan": (
        *("egovcp.data", "egovcp.robot", "egovcp.sim", "egovcp.log"),
        *("mujoco", "lerobot", "logging"),
    ),
    "egovcp/hub": (
        *("egovcp.data", "egovcp.robot", "egovcp.sim", "egovcp.model", "egovcp.plan"),
        "egovcp.log",
    ),
    "egovcp/robot": ("egovcp.sim", "egovcp.data", "egovcp.model", "egovcp.plan", "egovcp.log"),
    "egovcp/sim": ("egovcp.data", "egovcp.model", "egovcp.plan", "egovcp.log", "torch"),
    "egovcp/data": (
        "egovcp.robot",
        "egovcp.sim",
        "egovcp.model",
        "egovcp.plan",
        "egovcp.log",
        "egovcp.cli",
        "mujoco",
    ),
    "egovcp/log": ("egovcp.data", "egovcp.sim", "egovcp.plan", "egovcp.model"),
}


def imports(path: Path) -> set[str]:
    """Every module that the file imports, at any depth of its code."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def violations(folder: Path, forbidden: tuple[str, ...]) -> list[str]:
    return [
        f"{path.relative_to(ROOT)} imports {module}"
        for path in sorted(folder.rglob("*.py"))
        for module in sorted(imports(path))
        if any(module == name or module.startswith(f"{name}.") for name in forbidden)
    ]


def test_every_path_in_the_table_of_the_architecture_page_exists() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    missing, checked = [], 0
    for line in text.splitlines():
        folders = [ROOT]
        for name in re.findall(r"`([\w/]+(?:/|\.py))`", line.rpartition(" | ")[2]):
            # a file is in one of the folders named before it; a folder may also be beside one
            beside = [folder.parent for folder in folders[1:]] if name.endswith("/") else []
            found = [place / name for place in (*folders, *beside) if (place / name).exists()]
            checked += 1
            if found:
                folders.append(found[0] if found[0].is_dir() else found[0].parent)
            else:
                missing.append(f"{line[:40]}: {name}")
    assert missing == []
    assert checked > 60


@pytest.mark.parametrize("package", PACKAGES)
def test_applications_import_only_the_library(package: str) -> None:
    own = (package, "egovcp", *ALLOWED.get(package, ()))
    others = tuple(name for name in PACKAGES if name not in own)
    assert violations(PACKAGES[package], others) == []


@pytest.mark.parametrize("part", FORBIDDEN)
def test_arrows_inside_the_library_point_one_way(part: str) -> None:
    assert any((ROOT / part).glob("*.py"))
    assert violations(ROOT / part, FORBIDDEN[part]) == []


def test_a_violation_would_be_found(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text("def f():\n    from egovcp.sim import env\n")
    assert imports(tmp_path / "bad.py") == {"egovcp.sim.env"}


def wall_clock_readings(path: Path) -> list[str]:
    """Calls of functions whose answer jumps when somebody sets the clock."""
    calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    names = {f"{path.name}: {ast.unparse(call.func)}" for call in calls}
    jumping = ("time.time", "time.time_ns", "datetime.now", "datetime.utcnow", "time.localtime")
    return sorted(name for name in names if name.endswith(jumping))


def test_what_drives_a_robot_reads_no_clock_that_can_be_set() -> None:
    folder = PACKAGES["egovcp_deploy"]
    driving = [*folder.rglob("*.py"), ROOT / "egovcp" / "rate.py"]
    driving += [*(ROOT / "egovcp" / "log").rglob("*.py"), *(ROOT / "egovcp" / "plan").rglob("*.py")]
    assert len(driving) > 60
    assert [reading for path in driving for reading in wall_clock_readings(path)] == []


def test_a_reading_of_the_wall_clock_would_be_found(tmp_path: Path) -> None:
    (tmp_path / "late.py").write_text("import time\nstart = time.time()\n")
    assert wall_clock_readings(tmp_path / "late.py") == ["late.py: time.time"]


#: Where tasks may be named: in themselves, in the paper's experiments, and in what makes up
#: episodes for tests.
_NAMING = ("egovcp/sim/tasks", "experiment/egovcp_experiment", "egovcp/testing.py")


def test_only_tasks_name_tasks() -> None:
    word = re.compile('"(ball|wall|arch)"')
    files = [path for package in PACKAGES.values() for path in sorted(package.rglob("*.py"))]
    naming = [str(p.relative_to(ROOT)) for p in files if word.search(p.read_text(encoding="utf-8"))]
    assert [name for name in naming if not name.startswith(_NAMING)] == []
    assert any(name.startswith(_NAMING[0]) for name in naming)


@pytest.mark.parametrize("package", ["model", "plan", "log", "robot"])
def test_generic_packages_know_nothing_of_balls(package: str) -> None:
    word = re.compile(r"\b(balls?|flights?|throws?|thrown)\b", re.IGNORECASE)
    files = [p for p in (ROOT / "egovcp" / package).rglob("*") if p.suffix in {".py", ".c", ".h"}]
    assert files
    assert not [str(path) for path in files if word.search(path.read_text(encoding="utf-8"))]
