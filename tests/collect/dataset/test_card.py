"""`egovcp-dataset card`: metadata, tables, plots."""

import re
import shutil
from pathlib import Path

import datasets
import pytest
from huggingface_hub import DatasetCard
from lerobot.datasets.lerobot_dataset import LeRobotDataset

import egovcp_collect.dataset
from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader, Provenance, schema
from egovcp.data.metadata import verify_hashes
from egovcp.data.source import Source, write_source
from egovcp.help_text import field_docs
from egovcp.sim.tasks import task_names
from egovcp_collect.dataset import card
from egovcp_collect.dataset.card import CardConfig, _size_category, card_text, settings_tables
from egovcp_collect.dataset.cli import main

from .conftest import write
from .episodes import SETTINGS, three_balls, write_episodes

HOUSE = Path(__file__).resolve().parents[3]
IMAGE = re.compile(r"!\[[^]]*\]\(([^)]+)\)")


@pytest.fixture(scope="module")
def carded(tmp_path_factory: pytest.TempPathFactory) -> DatasetReader:
    """Three ball episodes with a card."""
    reader = write_episodes(tmp_path_factory.mktemp("data") / "three", three_balls())
    assert main(["card", str(reader.root), "--repo_id=me/three"]) == 0
    return reader


@pytest.fixture(scope="module")
def text(carded: DatasetReader) -> str:
    return (carded.root / "README.md").read_text()


def test_front_matter_is_valid(carded: DatasetReader) -> None:
    data = DatasetCard.load(carded.root / "README.md").data
    assert data.license == "apache-2.0"
    assert data.task_categories == ["robotics"]
    assert {"LeRobot", "egovcp", "unitree_g1", "depth"} <= set(data.tags)
    assert data.configs == [{"config_name": "default", "data_files": "data/*/*.parquet"}]


def test_an_id_without_a_user_is_refused(carded: DatasetReader) -> None:
    assert main(["card", str(carded.root), "--repo_id=three"]) == 2


def test_size_categories_are_those_of_the_hub() -> None:
    names = [_size_category(rows) for rows in (999, 1000, 10**7 - 1, 10**7)]
    assert names == ["n<1K", "1K<n<10K", "1M<n<10M", "10M<n<100M"]


def test_the_schema_is_complete(text: str) -> None:
    for key, feature in schema.FEATURES.items():
        kind = "image, uint16" if feature["dtype"] == "image" else feature["dtype"]
        shape = spec.FEATURES.get(key, feature)["shape"]
        shape = (spec.DEPTH_ROWS, spec.DEPTH_COLS) if key == spec.DEPTH_KEY else shape
        assert f"| `{key}` | {kind} | ({', '.join(map(str, shape))}" in text
    for part in spec.STATE_SLICES.values():
        assert f"| {part.start}:{part.stop} |" in text
    box = spec.ACTION_BOX
    for row in zip(spec.ACTION_NAMES, box.low, box.neutral, box.high, strict=True):
        assert "| `{}` | {} | {} | {} |".format(*row) in text
    assert f"`observation.state`, {spec.STATE_DIM} values" in text


def test_versions_that_read_the_files_are_named(text: str) -> None:
    metadata = schema.arrow_schema().metadata[b"huggingface"].decode()
    assert '"_type": "List"' in metadata  # which `datasets` knows since 4.0
    for words in (text, (HOUSE / "docs" / "data.md").read_text(encoding="utf-8")):
        assert "`datasets` 4.0 or newer" in words
        assert "LeRobot 0.6 or newer" in words


def test_collection_is_described(text: str) -> None:
    assert SETTINGS.command in text
    assert "mujoco 3.11.0" in text
    assert "stance-1" in text
    assert "every 5 to 15 ticks its target g becomes g + 1.0 d with d uniform" in text
    assert "approaches it by at most 0.32 per tick and is then held" in text
    assert "| `env.ball.radius_range` | 0.09 | 0.12 | Radius of the ball, m. |" in text
    assert "`env.ball.block_reward` | 1 | Once" in text
    assert "env.wall." not in text  # no such task in it


def test_a_walk_with_a_step_at_every_tick_is_described(tmp_path: Path) -> None:
    known = Provenance("stance-1", seed=5, config={"eta": 0.32, "step_ticks": [1, 1]})
    root = str(write(tmp_path / "data", [0], known))
    text = card_text(DatasetReader.open(DatasetConfig(root=root)), "me/steps")
    assert "section III-B):\na[t] = a[t-1] + 0.32 d with d uniform" in text
    assert "is then held" not in text


@pytest.mark.parametrize(
    ("origin", "words"),
    [
        ("", "| origin | not recorded"),
        ("recorded", "| origin | recorded rollouts"),
        ("converted", "| origin | converted from a LeRobot dataset, `me/theirs` 12ab;"),
    ],
)
def test_only_simulated_data_are_called_simulated_and_get_a_licence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], origin: str, words: str
) -> None:
    config = {"converted_from": {"repo_id": "me/theirs", "revision": "12ab"}}
    known = Provenance("stance-1", config=config, origin=origin)
    root = write(tmp_path / "data", [0], known)
    assert main(["card", str(root)]) == 0
    assert "the card names no licence" in capsys.readouterr().out
    text = (root / "README.md").read_text()
    assert words in text
    for claim in ("apache", "Apache", "simulated", "MuJoCo", "randomised", "personal data"):
        assert claim not in text
    assert DatasetCard.load(root / "README.md").data.license is None


def test_collected_data_of_earlier_versions_are_simulated(tmp_path: Path) -> None:
    known = Provenance("stance-1", seed=3, command="egovcp-collect --task=ball --seed=3")
    root = write(tmp_path / "data", [0], known)
    text = card_text(DatasetReader.open(DatasetConfig(root=str(root))), "me/earlier")
    assert "license: apache-2.0" in text


def test_columns_that_the_dataset_lacks_are_not_listed(
    sound: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader = DatasetReader.open(DatasetConfig(root=str(sound)))
    present = tuple(key for key in reader.features if key not in spec.OPTIONAL_KEYS)
    monkeypatch.setattr(DatasetReader, "features", present)
    text = card_text(reader, "me/earlier")
    assert not [key for key in spec.OPTIONAL_KEYS if f"| `{key}` |" in text]
    assert "| `next.truncated` | bool | (1,) |" in text


def test_every_setting_of_a_task_is_documented() -> None:
    env = SETTINGS.config["env"]
    for task in task_names(training=True):
        both = "\n".join(settings_tables(env, [task]))
        for name in (*env[task], *env["camera"], *env["randomise"], *env[f"{task}_episode"]):
            (line,) = {s for s in both.splitlines() if re.search(rf"`env\.\w+\.{name}`", s)} or {""}
            assert line, name
            assert not line.endswith("|  |"), f"no meaning: {line}"


def test_a_setting_of_another_version_has_no_documentation() -> None:
    drawn, constant = settings_tables({"ball": {"spin_range": [0.0, 1.0]}, "moon": True}, ["ball"])
    assert "| `env.ball.spin_range` | 0 | 1 |  |" in drawn
    assert "| `env.moon` | True |  |" in constant


def test_only_a_range_is_drawn() -> None:
    env = {
        "camera": {"edge_probability": [0.0, 0.25]},
        "ball": {"mount": [0.1, 0.5], "sides": ["left", "right"], "mass_range": [1.0, 1.0]},
        "ball_episode": {"event_ticks": [4, 20]},
    }
    drawn, constant = settings_tables(env, ["ball"])
    assert "| `env.camera.edge_probability` | 0 | 0.25 |" in drawn
    assert "| `env.ball_episode.event_ticks` | 4 | 20 |" in drawn
    assert "| `env.ball.mount` | 0.1, 0.5 |" in constant
    assert "| `env.ball.sides` | left, right |" in constant
    assert "| `env.ball.mass_range` | 1 |" in constant


def test_field_docs_read_fields_of_any_type() -> None:
    docs = dict(field_docs(CardConfig))
    assert set(docs) == set(CardConfig.__dataclass_fields__)


def test_plots_exist(carded: DatasetReader, text: str) -> None:
    found = IMAGE.findall(text)
    assert len(found) == 4
    assert all((carded.root / path).is_file() for path in found)


def test_the_pushed_card_equals_the_written_one(carded: DatasetReader, text: str) -> None:
    assert card_text(carded, "me/three") == text


def test_a_card_without_plots_shows_none(sound: Path) -> None:
    text = card_text(DatasetReader.open(DatasetConfig(root=str(sound))), "")
    assert IMAGE.findall(text) == []
    assert 'LeRobotDataset("user/six")' in text


def test_card_and_plots_do_not_change_the_data(carded: DatasetReader) -> None:
    verify_hashes(carded.root)
    DatasetReader.open(DatasetConfig(root=str(carded.root)))
    assert len(LeRobotDataset("me/three", root=carded.root)) == carded.num_frames
    loaded = datasets.load_dataset(str(carded.root), split="train", streaming=True)
    assert set(loaded.features) == set(schema.FEATURES)


def test_a_card_can_be_written_elsewhere(carded: DatasetReader, tmp_path: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in carded.root.rglob("*")}
    output = tmp_path / "cards" / "three.md"
    assert main(["card", str(carded.root), f"--output={output}"]) == 0
    found = IMAGE.findall(output.read_text())
    assert len(found) == 4
    assert all(path.startswith("assets/three/") for path in found)
    assert all((output.parent / path).is_file() for path in found)
    assert {p: p.stat().st_mtime_ns for p in carded.root.rglob("*")} == before


def test_the_hub_cache_is_not_changed(
    carded: DatasetReader,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(card, "draw_figures", lambda *_: [])
    cached = shutil.copytree(carded.root, tmp_path / "home/hub/datasets--me--three/snapshots/abc")
    assert main(["card", str(cached)]) == 2
    assert "give a file: --output=FILE" in capsys.readouterr().err
    pulled = shutil.copytree(carded.root, tmp_path / "pulled")
    write_source(Source(pulled, "me/three", "0" * 40))
    (pulled / "README.md").unlink()
    assert main(["card", str(pulled)]) == 0
    assert 'LeRobotDataset("me/three")' in (pulled / "README.md").read_text()


def test_the_linked_template_equals_the_packaged_one() -> None:
    shipped = Path(egovcp_collect.dataset.__path__[0]) / "card_template.md"
    assert (HOUSE / "dataset_cards" / "template.md").read_text() == shipped.read_text()


@pytest.mark.parametrize("task", task_names(training=True))
def test_the_example_cards_are_valid(task: str) -> None:
    path = HOUSE / "dataset_cards" / f"{task}.md"
    assert DatasetCard.load(path).data.license == "apache-2.0"
    found = IMAGE.findall(path.read_text())
    assert len(found) == 4
    assert all((path.parent / picture).is_file() for picture in found)


def test_a_merged_dataset_shows_the_settings_of_all_parts(tmp_path: Path) -> None:
    """Both walks are the same; noise and seeds differ."""
    env, folders = SETTINGS.config["env"], []
    for seed, hands in ((5, 0.01), (6, 0.02)):
        part = {**SETTINGS.config, "env": {**env, "pose_cost": hands}}
        known = Provenance("stance-1", seed=seed, config=part, origin="simulated")
        folders.append(str(write(tmp_path / f"{seed}", [seed], known)))
    merged = str(tmp_path / "merged")
    assert main(["merge", *folders, f"--output_dir={merged}"]) == 0
    text = card_text(DatasetReader.open(DatasetConfig(root=merged)), "me/merged")
    assert "| seed | 5, 6 |\n" in text
    assert "its target g becomes g + 1.0 d with d uniform" in text
    assert "license: apache-2.0" in text
    assert "The dataset was merged. Settings that are not the same" in text
    assert "| `env.ball.radius_range` | 0.09 | 0.12 | Radius of the ball, m. |" in text
    assert "env.pose_cost" not in text


def test_a_walk_that_is_not_that_of_all_parts_is_not_described(tmp_path: Path) -> None:
    folders = [
        str(write(tmp_path / f"{eta}", [n], Provenance("stance-1", seed=n, config={"eta": eta})))
        for n, eta in enumerate((0.3, 1.0))
    ]
    assert main(["merge", *folders, f"--output_dir={tmp_path / 'merged'}"]) == 0
    reader = DatasetReader.open(DatasetConfig(root=str(tmp_path / "merged")))
    text = card_text(reader, "me/merged")
    assert "The behaviour policy is not the same in all parts, or is not recorded. The base" in text
    assert "d uniform" not in text


def test_only_a_complete_collection_repeats_from_its_seed(sound: Path, tmp_path: Path) -> None:
    sentence = "| seed | 5; episode i is a function of the seed and i alone |"
    assert sentence in card_text(DatasetReader.open(DatasetConfig(root=str(sound))), "me/six")
    less = str(tmp_path / "less")
    assert main(["delete", str(sound), "--episodes=[0]", f"--output_dir={less}"]) == 0
    text = card_text(DatasetReader.open(DatasetConfig(root=less)), "me/five")
    assert "| seed | 5 |\n" in text
