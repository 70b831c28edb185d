"""Finds tasks: in the entry-point group ``egovcp.tasks``, and by reference, ``module:Class``."""

from __future__ import annotations

import dataclasses
import inspect
import keyword
import multiprocessing
import os
import re
import sys
import traceback
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import metadata
from types import FrameType
from typing import TYPE_CHECKING, Any, Final

from egovcp.errors import EgovcpError, EnvironmentFailure, UsageError, suggest
from egovcp.packages import SIMULATOR_MODULES, import_class, is_installed, require_packages
from egovcp.spec import ACTION_TERMS, REWARD_TERMS
from egovcp.terminal import echo

if TYPE_CHECKING:
    from egovcp.sim.tasks.base_task import BaseTask

GROUP: Final = "egovcp.tasks"
#: References of further tasks, separated by commas; child processes inherit it.
VARIABLE: Final = "EGOVCP_TASKS"
#: Stands for all tasks of the G1 of which datasets can be collected.
ALL_TASKS: Final = "all"
#: The task of commands without ``--task``.
DEFAULT_TASK: Final = "ball"

_NAME: Final = re.compile(r"[a-z][a-z0-9_]*")
#: What recordings hold beside the reward terms.
_RECORDED: Final = ("reward", "success", "terminated", "truncated")
_COLUMNS: Final = tuple(name for name in REWARD_TERMS if name not in (*ACTION_TERMS, "fall"))


@dataclass(frozen=True)
class TaskEntry:
    """A task that was found."""

    name: str
    origin: str
    """What provides it: ``egovcp 0.1.0``, or a reference."""
    reference: str
    """``module:Class``."""
    task: type[BaseTask] | None
    """None: it cannot be used because of `problem`."""
    problem: str = ""

    @property
    def failure(self) -> str:
        """One line that names the plugin and what to do."""
        installed = self.origin != self.reference
        name = f"{self.name!r} of {self.origin}" if installed else self.reference
        remedy = "repair or uninstall it" if installed else "correct the name or the class"
        return f"task {name} cannot be used: {self.problem}; {remedy}"


_found: list[TaskEntry] | None = None


def task_entries() -> tuple[TaskEntry, ...]:
    """All tasks: those with a `Task.seed_key` first, then by name.

    The first call imports the plugins. What cannot be used is reported once, in one line each on
    stderr, and stays in the list. Without the simulator there is none.
    """
    global _found
    if _found is None:
        if not all(map(is_installed, SIMULATOR_MODULES)):
            return ()
        _found = []  # a plugin may use the registry while it is imported
        points: Iterable[Any] = metadata.entry_points(group=GROUP)
        for point in sorted(points, key=lambda p: (p.dist.name != "egovcp", p.dist.name)):
            _add(point.name, f"{point.dist.name} {point.dist.version}", point.value)
        for reference in filter(None, os.environ.get(VARIABLE, "").split(",")):
            _add("", reference, reference)
        if multiprocessing.parent_process() is None:
            for entry in _found:
                if entry.problem:
                    echo(f"warning: {entry.failure}", error=True)
    return tuple(sorted(_found, key=_place))


def _place(entry: TaskEntry) -> tuple[float, str]:
    key = entry.task.seed_key if entry.task else None
    return (float("inf") if key is None else key, entry.name)


def _add(name: str, origin: str, reference: str) -> TaskEntry:
    """Import ``module:Class`` and append its entry; an empty ``name`` is that of the class."""
    assert _found is not None
    try:
        from egovcp.sim.tasks.base_task import BaseTask

        task = import_class(reference, BaseTask, "Task or RobotTask of egovcp.sim.tasks")  # type: ignore[type-abstract]
        _check(task)
        if name and name != task.name:
            raise ValueError(f"the class {reference} is named {task.name!r}; use one name")
        for other in _found:
            if other.name == task.name and other.task is not None:
                raise ValueError(f"its name, {task.name!r}, is that of a task of {other.origin}")
        entry = TaskEntry(task.name, origin, reference, task)
    except Exception as error:  # noqa: BLE001 - whatever the import of a plugin raises
        kind = "" if isinstance(error, ValueError | EgovcpError) else f"{type(error).__name__}: "
        problem = kind + " ".join(str(error).split())
        entry = TaskEntry(name or reference, origin, reference, None, problem)
    _found.append(entry)
    return entry


def _check(task: type[BaseTask]) -> None:
    """Raise `ValueError` unless the class is complete."""
    missing = sorted(task.__abstractmethods__)
    missing += [a for a in ("name", "description", "terms") if not hasattr(task, a)]
    missing += _missing_of_robot(task)
    if missing:
        raise ValueError(f"the class lacks {', '.join(missing)}")
    if problem := name_problem(task.name):
        raise ValueError(problem)
    for term, column in task.terms.items():
        if not _NAME.fullmatch(term) or term in _RECORDED:
            raise ValueError(
                f"{term!r} cannot be the name of a reward term: use lower-case letters, digits and "
                f"_, and none of {', '.join(_RECORDED)}"
            )
        if column not in _COLUMNS:
            raise ValueError(
                f"terms[{term!r}] is {column!r}, expected one of {', '.join(_COLUMNS)}"
            )
        if term in (*ACTION_TERMS, "fall"):
            raise ValueError(f"{term!r} is a reward term of every task; leave it out of terms")
    if inspect.isclass(task.config) or not dataclasses.is_dataclass(task.config):
        raise ValueError("config is no instance of a dataclass derived from TaskConfig")


def _missing_of_robot(task: type[BaseTask]) -> list[str]:
    """What the robot of a `RobotTask` lacks."""
    from egovcp.sim.mujoco_robot import MujocoRobot
    from egovcp.sim.tasks.robot_task import RobotTask

    if not issubclass(task, RobotTask):
        if task.robot_spec().is_g1:
            return []
        raise ValueError("its robot is not the G1; derive it from egovcp.sim.tasks.RobotTask")
    robot = getattr(task, "robot_class", None)
    if robot is None:
        return ["robot_class"]
    if not (inspect.isclass(robot) and issubclass(robot, MujocoRobot)):
        raise ValueError(f"its robot_class is {robot!r}, expected a subclass of MujocoRobot")
    missing = [*sorted(robot.__abstractmethods__)]
    missing += [a for a in ("spec", "control_id") if not hasattr(robot, a)]
    return [f"robot_class.{name}" for name in missing]


def name_problem(name: str) -> str:
    """Why a task cannot have this name; empty: it can."""
    from egovcp.sim.config import BaseEnvConfig

    rules = {
        "use lower-case letters, digits and _, a letter first": _NAME.fullmatch(name) is None,
        "it is a Python keyword": keyword.iskeyword(name),
        "--task=all selects all tasks": name == ALL_TASKS,
        "names of options end in _episode": name.endswith("_episode"),
        "it is an option of --env": name in [o.name for o in dataclasses.fields(BaseEnvConfig)],
    }
    broken = [rule for rule, is_broken in rules.items() if is_broken]
    return f"{name!r} cannot be the name of a task: {broken[0]}" if broken else ""


def register_task(reference: str) -> str:
    """Add the task ``package.module:Class`` for this process and its children; returns its name.

    Modules in the working folder are found. Commands do this for ``--task``.

    Raises:
        UsageError: it cannot be imported, or is not a complete task; the message says why.
        MissingPackage: the simulator is not installed.
    """
    require_packages("egovcp", f"--task={reference}", *SIMULATOR_MODULES)
    folder = os.getcwd()
    if folder not in sys.path:
        sys.path.append(folder)
    for entry in task_entries():
        if entry.reference == reference and entry.task is not None:
            return entry.name
    entry = _add("", reference, reference)
    if entry.task is None:
        assert _found is not None
        _found.remove(entry)
        raise UsageError(entry.failure)
    known = filter(None, (os.environ.get(VARIABLE, ""), reference))
    os.environ[VARIABLE] = ",".join(known)
    return entry.name


def plugin_failure(error: Exception) -> EnvironmentFailure | None:
    """The failure of the task in whose code, or whose robot's, ``error`` was raised; None: in that
    of no task but egovcp's own."""
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        if task := _task_of(frame):
            where = f"{os.path.basename(frame.f_code.co_filename)}, line {line}"
            return task.error(f"{type(error).__name__} in {where}: {error}")
    return None


def _task_of(frame: FrameType) -> type[BaseTask] | None:
    """The task whose method, or whose robot's, a frame runs, else the first one that has a class in
    its module; None for egovcp's own code."""
    module = str(frame.f_globals.get("__name__", ""))
    if module.startswith("egovcp."):
        return None
    owner = frame.f_locals.get("self", frame.f_locals.get("cls"))
    own, near = owner if inspect.isclass(owner) else type(owner), None
    for task in (entry.task for entry in task_entries() if entry.task is not None):
        classes = (task, getattr(task, "robot_class", task))
        if own in classes:
            return task
        if near is None and any(base.__module__ == module for c in classes for base in c.__mro__):
            near = task
    return near


def installed_task(name: str) -> type[BaseTask] | None:
    """The usable task of this name; None if there is none."""
    tasks = (entry.task for entry in task_entries() if entry.name == name)
    return next((task for task in tasks if task is not None), None)


def find_task(name: str, option: str = "") -> type[BaseTask]:
    """The task of this name; ``option`` is named in the error.

    Raises:
        UsageError: no task has this name.
        EnvironmentFailure: its plugin is defective.
    """
    found = installed_task(name)
    if found is not None:
        return found
    entries = task_entries()
    for entry in entries:
        if entry.name == name:
            raise EnvironmentFailure(entry.failure)
    require_packages("egovcp", f"the task {name!r}", *SIMULATOR_MODULES)
    where = f"{option}: " if option else ""
    if ":" in name:
        raise UsageError(
            f"{where}task {name} is not registered: give the flag --task={name} (a file cannot "
            "register a task), or call egovcp.sim.tasks.register_task"
        )
    known = suggest(name, task_names()) if entries else "; install egovcp again: it has no tasks"
    raise UsageError(
        f"{where}unknown task {name!r}{known}; a task of another package needs that package "
        f"(entry-point group {GROUP}), or --task=package.module:Class"
    )


def task_names(training: bool = False) -> tuple[str, ...]:
    """Names of all usable tasks; with ``training``, of those that datasets are collected of."""
    tasks = [entry.task for entry in task_entries() if entry.task is not None]
    return tuple(task.name for task in tasks if task.for_training or not training)


def select_tasks(text: str, training: bool = False) -> tuple[str, ...]:
    """The tasks that ``--task`` selects: one, several separated by commas, or ``all``.

    Raises:
        UsageError: there is no such task, or, with ``training``, not for this purpose.
        EnvironmentFailure: the plugin of one is defective.
    """
    if text == ALL_TASKS:
        every = task_names(training=True)
        return tuple(name for name in every if find_task(name).robot_spec().is_g1)
    names = tuple(dict.fromkeys(text.strip("[]").replace(" ", "").split(",")))
    for name in names:
        if not find_task(name, "--task").for_training and training:
            raise UsageError(f"--task={name}: it is only for evaluation; choose single tasks")
    return names


def seed_key(name: str) -> int:
    """Key of a task's random streams; raises as `find_task`."""
    key = find_task(name).seed_key
    return zlib.crc32(name.encode()) if key is None else key


def describe_task(name: str) -> str:
    """`Task.description`; empty for a task that is not installed."""
    task = installed_task(name)
    return task.description if task else ""
