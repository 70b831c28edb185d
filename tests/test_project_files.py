"""The files that a public project has are complete and valid."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
PROJECTS = [ROOT, *(ROOT / name for name in ("collect", "train", "deploy", "experiment"))]
PROJECTS += sorted(path.parent for path in (ROOT / "plugins").glob("*/pyproject.toml"))
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))


@pytest.mark.parametrize("project", PROJECTS, ids=lambda path: path.name)
def test_a_distribution_has_metadata_a_readme_and_types(project: Path) -> None:
    content = tomllib.loads((project / "pyproject.toml").read_text())
    table = content["project"]
    assert (project / table["readme"]).is_file()
    assert {"Repository", "Documentation", "Changelog"} <= set(table["urls"])
    assert "Typing :: Typed" in table["classifiers"]
    (package,) = content["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert (project / package / "py.typed").is_file()


def _workflow(path: Path) -> dict[Any, Any]:
    content = yaml.safe_load(path.read_text())
    assert isinstance(content, dict)
    return content


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_a_workflow_has_the_structure_that_github_expects(path: Path) -> None:
    workflow = _workflow(path)
    # YAML 1.1 reads the key `on` as true.
    assert set(workflow) <= {"name", True, "permissions", "concurrency", "jobs"}
    assert set(workflow[True]) <= {"push", "pull_request", "schedule", "workflow_dispatch"}
    for job in workflow["jobs"].values():
        known = {"runs-on", "timeout-minutes", "steps", "needs", "environment", "permissions"}
        assert {"runs-on", "steps"} <= set(job) <= known
        needs = job.get("needs", [])
        assert set([needs] if isinstance(needs, str) else needs) <= set(workflow["jobs"])
        for step in job["steps"]:
            assert ("uses" in step) != ("run" in step)
            assert set(step) <= {"name", "uses", "with", "run", "env"}
            if "uses" in step:
                assert re.fullmatch(r"[\w-]+/[\w-]+@(v\d+|release/v\d+)", step["uses"])


def test_only_the_publishing_job_may_request_a_token() -> None:
    found = [
        (path.name, name)
        for path in WORKFLOWS
        for name, job in _workflow(path)["jobs"].items()
        if "id-token" in job.get("permissions", {})
    ]
    assert found == [("release.yml", "publish")]


def test_the_home_page_shows_the_beginning_of_the_readme() -> None:
    page, readme = ((ROOT / name).read_text() for name in ("docs/index.md", "README.md"))
    (shown,) = re.findall(r'--8<-- "README.md:(\d+):(\d+)"', page)
    first, last = map(int, shown)
    lines = readme.splitlines()
    assert not lines[first - 2]
    assert lines[first - 1].startswith("**Train")
    assert lines[last + 1].startswith("![")


def test_the_citation_names_the_version_and_the_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert citation["version"] == version
    assert "Contact Planning" in citation["preferred-citation"]["title"]
