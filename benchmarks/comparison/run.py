"""One run of a comparison: train one method on one task with one seed, then evaluate every goal.

A run owns a folder: `stage_0`, `stage_1`, ... with what `recipes.train` writes, `result.json` once it is
finished, `log.txt` with everything it printed. So a run that was killed is continued by executing it again,
and a finished one is recognised by its result. A file that is damaged is named and left as it is.
"""

import contextlib
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from comparison.environments import environment
from comparison.files import Damaged, Kind, check_kinds, plain, read_json, write_json
from comparison.provenance import origin
from tasks.environment import BatchedEnv
from tasks.evaluation import Evaluation, evaluate
from tasks.settings import Setting
from torchrl_sym.recipes import PPOConfig, load_actor, read_metrics, train_stages
from torchrl_sym.recipes.runs import read_progress, stage_folders, trained_folder

EVALUATION_SEED = 1000  # the same starts for every run
MAX_STEPS = 10_000  # of an episode in evaluation
EXPLORATION = {"deterministic": ExplorationType.DETERMINISTIC, "sampled": ExplorationType.RANDOM}
# What the files of a run hold.
_NUMBER = (int, float)
_REQUEST: dict[str, Kind] = {"task": str, "method": str, "seed": int, "stages": list, "origins": list}
_RESULT: dict[str, Kind] = _REQUEST | {
    **{"episodes": int, "evaluations": dict, "outcome": str, "iterations": int},
    **{"frames": _NUMBER, "seconds": _NUMBER, "evaluation": list},
}
_ROW: dict[str, Kind] = {"what": str, "actions": str, "goal": str, "return": (*_NUMBER, str)}
_ORIGIN: dict[str, Kind] = {"revision": str, "versions": dict, "machine": str}
_STAGE: dict[str, Kind] = {"config": dict, "task": dict}


@dataclass(frozen=True)
class Run:
    """What to train, and where.

    Attributes:
        task: its name, see `environments.py`.
        method: its name in the results.
        seed: seed of weights, starts and exploration.
        setting: hyper-parameters, all stages.
        folder: where it keeps its files.
        episodes: evaluation episodes per goal.
        threads: physics and torch threads.
    """

    task: str
    method: str
    seed: int
    setting: Setting
    folder: Path
    episodes: int = 500
    threads: int = 1

    def __str__(self) -> str:
        return f"{self.task} {self.method} {self.seed}"

    def request(self) -> dict[str, Any]:
        """What was asked for, as JSON; numbers that are not finite as text, which JSON lacks."""
        asked = {"task": self.task, "method": self.method, "seed": self.seed}
        asked["stages"] = described(self.setting)
        return asked | {"episodes": self.episodes, "evaluations": plain(self.setting.evaluations)}

    def result(self) -> dict[str, Any] | None:
        """The result, if this very run has been finished and its file is whole; see `damage`."""
        with contextlib.suppress(Damaged):
            result = self._stored()
            if result and _asks(result, self.request()):
                return result
        return None

    def damage(self) -> str | None:
        """Which file of the run is damaged, and what to do about it; None if none is."""
        try:
            result = self._stored()
            if result:
                self.curve(result)
            else:
                self._begun()
        except Damaged as error:
            return str(error)
        return None

    def curve(self, result: dict[str, Any]) -> list[dict[str, float]]:
        """The metrics of every iteration that led to a result.

        Raises:
            Damaged: some are missing, or cannot be read.
        """
        remedy = "restore it, or delete the folder, and the run begins anew"
        try:
            rows = read_curve(self.folder)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise Damaged(f"expected whole metrics in {self.folder}, got {error!r}; {remedy}") from error
        if len(rows) != result["iterations"]:
            raise Damaged(
                f"expected metrics of {result['iterations']} iterations in {self.folder} (metrics.csv), "
                f"got {len(rows)}; {remedy}"
            )
        return rows

    def _stored(self) -> dict[str, Any]:
        remedy = "delete it, and the run is evaluated again from its checkpoint"
        return self._read("result.json", _RESULT, remedy)

    def _begun(self) -> dict[str, Any]:
        remedy = f"restore it, or delete {self.folder}, and the run begins anew"
        return self._read("request.json", _REQUEST, remedy)

    def _read(self, name: str, kinds: dict[str, Kind], remedy: str) -> dict[str, Any]:
        path = self.folder / name
        content = read_json(path, kinds, remedy)
        for key, each in {"evaluation": _ROW, "origins": _ORIGIN, "stages": _STAGE}.items():
            for row in content.get(key, []):
                check_kinds(path, row, each, remedy)
        return content

    def progress(self) -> tuple[int, float]:
        """Iterations done so far, and the latest mean return (NaN at first)."""
        return read_progress(self.folder)

    @property
    def iterations(self) -> int:
        """Iterations in all."""
        return sum(stage.config.iterations for stage in self.setting.stages)

    def execute(self, code: dict[str, Any] | None = None) -> None:
        """Train and evaluate, from wherever the folder is; other processes on the same folder wait.

        Args:
            code: `origin` when the code of this process was loaded; now, by default.

        Raises:
            ValueError: the folder holds a run that was asked for differently.
            Damaged: a file of the run is; nothing is overwritten.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(self.folder / "lock"):
            if message := self.damage():
                raise Damaged(message)
            if self.result() is None:
                self._execute(self._claim_folder(code or origin()))

    def _claim_folder(self, code: dict[str, Any]) -> list[dict[str, Any]]:
        """What is continued must have begun as the same run: its past decides its future.

        Returns all code that it has been trained with, an origin each.
        """
        asked = {key: self.request()[key] for key in ("task", "method", "seed", "stages")}
        begun = self._begun()
        if begun and not _asks(begun, asked):
            raise ValueError(
                f"expected {self.folder} to be new or to hold {self} as it is asked for now, got a run "
                "with other settings (request.json); use another --name, or delete the folder"
            )
        origins = begun.get("origins", [])
        origins += [code] * (code not in origins)
        write_json(self.folder / "request.json", asked | {"origins": origins})
        return origins

    def _execute(self, origins: list[dict[str, Any]]) -> None:
        torch.set_num_threads(self.threads)
        make_env = environment(self.task, self.threads)
        outcome = "finished"
        try:
            stages = self.setting.stages
            symmetry = make_env(num_envs=1, seed=0, **stages[0].task).symmetry
            train_stages(stages, make_env, symmetry, folder=self.folder).run()
        except FloatingPointError as error:  # a result like any other: the same seed would end here again
            outcome = f"diverged: {error}"
        curve = read_curve(self.folder)
        ended = {
            "outcome": outcome,
            "iterations": len(curve),
            "frames": curve[-1]["frames"] if curve else 0,
            "seconds": curve[-1]["seconds"] if curve else 0.0,
            "evaluation": self._evaluate(make_env),
        }
        write_json(self.folder / "result.json", self.request() | {"origins": origins} | ended)

    def _evaluate(self, make_env: Callable[..., EnvBase]) -> list[dict[str, Any]]:
        """One row per evaluated task, kind of actions and goal; none if it diverged before a checkpoint."""
        rows: list[dict[str, Any]] = []
        checkpoint = last_checkpoint(self.folder)
        if checkpoint is None:
            return rows
        for what, kwargs in self.setting.evaluations.items():
            env = make_env(num_envs=1, seed=EVALUATION_SEED, **kwargs)
            actor = load_actor(checkpoint, env, env.symmetry)
            for actions, exploration in EXPLORATION.items():
                if isinstance(env, BatchedEnv):
                    threads = {"num_threads": self.threads, "exploration": exploration}
                    outcome = evaluate(env, actor, self.episodes, seed=EVALUATION_SEED, **threads)
                else:
                    many = make_env(num_envs=self.episodes, seed=EVALUATION_SEED, **kwargs)
                    outcome = evaluate_plainly(many, actor, exploration)
                rows += [{"what": what, "actions": actions, **row} for row in goal_rows(outcome)]
        return rows


def described(setting: Setting) -> list[dict[str, Any]]:
    """What every stage of a setting trains with, as JSON."""
    return [
        {"config": plain(dataclasses.asdict(stage.config)), "task": plain(stage.task)}
        for stage in setting.stages
    ]


def _asks(stored: dict[str, Any], request: dict[str, Any]) -> bool:
    """Whether a stored run is the requested one."""
    stored = stored | {"stages": completed(stored["stages"])}
    return all(stored.get(key) == value for key, value in request.items())


def completed(stages: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What stored stages were trained with: a field that was added since then had its default."""
    defaults = plain(dataclasses.asdict(PPOConfig()))
    return [stage | {"config": defaults | stage["config"]} for stage in stages]


def last_checkpoint(folder: Path) -> Path | None:
    """Where the policy of a run is; None if it diverged before it had learned anything."""
    try:
        return trained_folder(folder)
    except FileNotFoundError:
        return None


def read_curve(folder: Path) -> list[dict[str, float]]:
    """Metrics of all stages, with frames and seconds counted through."""
    whole: list[dict[str, float]] = []
    for number, stage in enumerate(stage_folders(folder)):
        table = stage / "metrics.csv"
        before = whole[-1] if whole else {"frames": 0, "seconds": 0.0}
        for row in read_metrics(table) if table.exists() else []:
            through = {key: row[key] + before[key] for key in ("frames", "seconds")}
            whole.append({"stage": number, **row, **through})
    return whole


def goal_rows(outcome: Evaluation) -> list[dict[str, Any]]:
    """Return, return of the task's own terms, success and behaviour of every goal; None if undefined."""
    return [
        {
            **outcome.goal_behaviours[goal],
            "goal": goal,
            "return": value,
            "task_return": outcome.task_means.get(goal),
            "success": outcome.goal_successes.get(goal),
        }
        for goal, value in outcome.goal_means.items()
    ]


def evaluate_plainly(
    env: EnvBase, actor: ProbabilisticTensorDictSequential, exploration: ExplorationType
) -> Evaluation:
    """Return of one episode per row of an environment whose equivalent goals are not known.

    Raises:
        ValueError: an episode does not end.
    """
    with torch.no_grad(), set_exploration_type(exploration):
        following = env.reset()
        running = ~following["done"]
        returns = torch.zeros(running.shape, dtype=torch.float64)
        for _ in range(MAX_STEPS):
            tensordict, following = env.step_and_maybe_reset(actor(following))
            returns += tensordict["next", "reward"].double() * running
            running &= ~tensordict["next", "done"]
            if not bool(running.any()):
                return Evaluation(("all",), returns.reshape(1, -1))
    raise ValueError(
        f"expected episodes of at most {MAX_STEPS} steps, got some that go on; end them, for example with "
        "TransformedEnv(env, StepCounter(max_steps=...))"
    )
