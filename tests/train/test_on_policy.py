"""The loop of PPO's iterations: what a signal and a divergence leave behind."""

import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from egovcp.errors import DataError
from egovcp_train import on_policy
from egovcp_train.checkpoint import load_training_state
from egovcp_train.lowlevel.train import LowLevelTrainConfig

LAST = Path("checkpoints/last/pretrained_model/policy.txt")


class _Learner:
    """Ten steps per iteration, without networks."""

    is_finite = True

    def __init__(self, before: Callable[[int], object] = lambda number: None) -> None:
        """``before`` is called with the number of the iteration that begins."""
        self.iteration, self._before = 0, before

    @property
    def steps(self) -> int:
        return 10 * self.iteration

    def iterate(self) -> dict[str, float]:
        self._before(self.iteration + 1)
        self.iteration += 1
        return {"reward": 0.5}

    def state_dict(self) -> dict[str, Any]:
        return {"iteration": self.iteration}


def _run(learner: Any, output: Path, write: Callable[[Path], object] = lambda folder: None) -> None:
    def write_policy(folder: Path) -> None:
        write(folder)
        (folder / LAST.name).write_text("weights")

    config = LowLevelTrainConfig(str(output), steps=30)
    on_policy.run_iterations(
        learner, config, output, {}, write_policy, lambda _: {}, "{} {}".format
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_the_last_state_is_saved_does_not_lose_it(
    tmp_path: Path, number: signal.Signals
) -> None:
    _run(_Learner(), tmp_path, lambda folder: signal.raise_signal(number))
    assert load_training_state(tmp_path)["iteration"] == 3
    assert (tmp_path / LAST).is_file()


def test_a_signal_before_the_first_iteration_leaves_the_policy_that_the_message_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(on_policy, "tqdm", _interrupted(on_policy.tqdm))
    with pytest.raises(KeyboardInterrupt):
        _run(_Learner(), tmp_path)
    (folder, _, _) = capsys.readouterr().out.partition(" stopped early")
    assert (Path(folder) / LAST.name).is_file()


def _interrupted(bar: Callable[..., Any]) -> Callable[..., Any]:
    def build(**options: object) -> Any:
        signal.raise_signal(signal.SIGINT)
        return bar(**options)

    return build


def test_scalars_before_a_divergence_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, learner = (
        list[object](),
        _Learner(lambda number: vars(learner).update(is_finite=number < 2)),
    )
    logger = SimpleNamespace(
        log_scalars=lambda *given: log.append(given), close=lambda: log.append(0)
    )
    monkeypatch.setattr(on_policy, "TensorBoardLogger", lambda output: logger)
    with pytest.raises(DataError, match="PPO diverged in iteration 2"):
        _run(learner, tmp_path)
    assert log == [(10, {"reward": 0.5}), 0]
