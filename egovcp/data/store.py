"""Episodes as contiguous arrays in memory, with their targets, and windows of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp.data import privileged
from egovcp.data.episode import Episode, FrameLayout, frame_layout
from egovcp.data.index import EpisodeIndex, episodes_fingerprint
from egovcp.data.reader import DatasetReader
from egovcp.data.returns import ReturnConfig, is_terminal, mc_return, mc_valid
from egovcp.robot_spec import G1, RobotSpec

type Batch = dict[str, NDArray[Any]]

_FROM_EPISODE: Final = ("depth", "state", "action")
_VALUES: Final = ("depth", "state", "action", "prev_action", "privileged", "reward", "mc_return")
_FLAGS: Final = ("terminal_next", "mc_valid")


def _arrays(robot: RobotSpec) -> Mapping[str, FrameLayout]:
    layout = frame_layout(robot)
    return {
        **{name: layout[name] for name in _FROM_EPISODE},
        "privileged": ((privileged.DIM,), np.float32),
        "reward": layout["reward"],
        "prev_action": layout["action"],
        "terminal_next": ((), np.bool_),
        "mc_return": ((), np.float32),
        "mc_valid": ((), np.bool_),
    }


@dataclass(frozen=True)
class EpisodeStore:
    """N frames of E episodes, one after the other; arrays without another shape are (N,).

    The shapes of images, states and actions are those of the G1.
    """

    depth: NDArray[np.uint16]
    """(N, 48, 64) mm; (0, 48, 64) if the images were left out."""
    state: NDArray[np.float32]
    """(N, 74)."""
    action: NDArray[np.float32]
    """(N, 7)."""
    prev_action: NDArray[np.float32]
    """(N, 7) action of the row before; zeros, the neutral pose, at the first row."""
    privileged: NDArray[np.float32]
    """(N, F) `egovcp.data.privileged`."""
    reward: NDArray[np.float32]
    """(N,) see `ReturnConfig.target_reward`."""
    terminal_next: NDArray[np.bool_]
    """(N,) the row's action led to a failure."""
    mc_return: NDArray[np.float32]
    mc_valid: NDArray[np.bool_]
    start: NDArray[np.int64]
    """(E,) first frame of each episode."""
    length: NDArray[np.int64]
    """(E,) frames of each episode."""
    dataset: NDArray[np.int64]
    """(E,) dataset of each episode."""
    tasks: tuple[str, ...]
    """(E,) task of each episode; for sampling and reports, never for the network."""
    identities: tuple[str, ...]
    """(E,) `DatasetReader.identity` of each episode."""
    robot: RobotSpec = G1
    """The robot of all episodes."""

    @classmethod
    def load(
        cls,
        readers: Sequence[DatasetReader],
        split: str = "all",
        returns: ReturnConfig | None = None,
        *,
        per_task: int | None = None,
    ) -> Self:
        """Read the episodes of a split, at most ``per_task`` of each task, into memory.

        A frame takes 6.3 kB, nearly all depth.
        """
        index = EpisodeIndex.of(readers, split)
        return cls.read(index if per_task is None else index.subsample(per_task), returns)

    @classmethod
    def read(
        cls, index: EpisodeIndex, returns: ReturnConfig | None = None, images: bool = True
    ) -> Self:
        """Read and validate all episodes of an index, and store their images or not."""
        store = cls.empty(
            index.length, index.dataset, index.tasks, index.identities, images, index.robot
        )
        for number in tqdm(range(len(index)), unit="ep", desc="read", delay=1, leave=False):
            store.fill(number, index.read(number), returns or ReturnConfig())
        return store

    @classmethod
    def empty(
        cls,
        length: NDArray[np.int64],
        dataset: NDArray[np.int64],
        tasks: tuple[str, ...] = (),
        identities: tuple[str, ...] = (),
        images: bool = True,
        robot: RobotSpec = G1,
    ) -> Self:
        """Allocate arrays for episodes of these lengths."""
        frames = int(length.sum())
        arrays: dict[str, NDArray[Any]] = {
            name: np.empty((frames if images or name != "depth" else 0, *shape), dtype=dtype)
            for name, (shape, dtype) in _arrays(robot).items()
        }
        start = length.cumsum() - length
        return cls(
            **arrays,
            start=start,
            length=length,
            dataset=dataset,
            tasks=tasks,
            identities=identities,
            robot=robot,
        )

    def fill(self, number: int, episode: Episode, config: ReturnConfig) -> None:
        """Write an episode and its targets to the frames of episode ``number``."""
        first = int(self.start[number])
        rows = slice(first, first + len(episode))
        for name in _FROM_EPISODE:
            if name != "depth" or len(self.depth):
                getattr(self, name)[rows] = getattr(episode, name)
        self.privileged[rows] = privileged.privileged_features(
            episode.object, episode.reward_terms, self.robot.planner_hz
        )
        self.prev_action[first] = 0.0
        self.prev_action[first + 1 : rows.stop] = episode.action[:-1]
        self.terminal_next[rows] = is_terminal(episode.done, episode.truncated)
        reward = config.target_reward(episode.reward, episode.reward_terms)
        self.reward[rows] = reward
        self.mc_return[rows] = mc_return(reward, config.gamma, config.steps)
        self.mc_valid[rows] = mc_valid(
            len(episode), episode.time_limit, config.steps, config.keep_truncated
        )

    @property
    def num_frames(self) -> int:
        """Frames of all episodes."""
        return len(self.reward)

    @property
    def fingerprint(self) -> str:
        """Hash of the episodes (see `episodes_fingerprint`)."""
        return episodes_fingerprint(self.identities, self.length)


def gather(
    store: EpisodeStore, start: NDArray[np.int64], episode: NDArray[np.int64], span: int
) -> Batch:
    """Windows of ``span`` rows, each from one episode, as arrays ``[B, span, ...]``.

    Keys: the arrays of the store, is_first, valid; for reports episode [B], t [B, span]. Past the
    episode's end the last row is repeated with ``valid``, ``mc_valid`` and the flags false.
    """
    end = store.start[episode] + store.length[episode]
    wanted = start[:, None] + np.arange(span)
    valid = wanted < end[:, None]
    rows = np.minimum(wanted, end[:, None] - 1)
    t = rows - store.start[episode][:, None]
    batch: Batch = {name: getattr(store, name)[rows] for name in _VALUES}
    for name in _FLAGS:
        batch[name] = getattr(store, name)[rows] & valid
    batch |= {"is_first": (t == 0) & valid, "valid": valid, "episode": episode, "t": t}
    return batch


def mirror_windows(batch: Batch, windows: NDArray[np.intp], robot: RobotSpec = G1) -> None:
    """Mirror ``windows`` of a batch left to right, in place; the robot is symmetric and its camera
    is in the plane of symmetry."""
    batch["depth"][windows] = batch["depth"][windows, ..., ::-1]
    batch["state"][windows] = robot.mirrored_state(batch["state"][windows])
    batch["privileged"][windows] = privileged.mirror_privileged(batch["privileged"][windows])
    for name in ("action", "prev_action"):
        batch[name][windows] = robot.mirrored_action(batch[name][windows])
