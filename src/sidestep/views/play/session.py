"""One visitor's world: its simulation, and the frames sent to the visitor."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from sidestep._arrays import real
from sidestep.safety.certificate.situation import plain
from sidestep.safety.filter.status import Status
from sidestep.views.play import control
from sidestep.views.play.limits import Limits
from sidestep.views.play.messages import (
    Drive,
    Message,
    MessageError,
    Move,
    Numbers,
    Pace,
    Pause,
    Pick,
    Reader,
    Reset,
    Restore,
    Seen,
    Show,
    Step,
)
from sidestep.views.play.program import traced
from sidestep.views.play.programs import Programs
from sidestep.views.play.recording import Recording
from sidestep.views.play.rules import PATIENCE, TRIES, is_touching
from sidestep.views.play.score import Score
from sidestep.views.play.sliders import YOU, drifts_at, numbers_of, sliders_for, with_numbers
from sidestep.views.play.verdict import quick_verdict, verdict
from sidestep.world import Scenario, World

_PLAN_EVERY = 5


@final
class Session:
    """A world simulated period by period, for one visitor. Not thread-safe.

    The robot drives from target to target: a target that is reached, or not reached within `PATIENCE`, is
    replaced. A capture or a collision ends the episode (`outcome`); `restart` begins the next. While the
    shield's program is being compiled, `advance` does nothing.
    """

    def __init__(self, programs: Programs, shield: str, pursuer: str, limits: Limits, seed: int):
        self.programs, self.limits = programs, limits
        self.base: Scenario = programs.scenario
        self.sliders = sliders_for(self.base)
        self.reader = Reader(
            self.sliders, self.base.pursuer_count, self.base.obstacle_count, limits.message_bytes
        )
        self.period = plain(self.base.control_period)
        self.shield, self.pursuer = shield, pursuer
        self.paused, self.pace = False, 1.0
        self.show = Show(rows=False, plan=False)
        self.score = Score()
        self.outcome: str | None = None
        self.frame_number = 0
        self._random = np.random.default_rng(seed)
        self._recording = Recording(programs.layout.place, programs.layout.outputs, limits.recorded_periods)
        self._drive = Drive()
        self._output: dict[str, Any] | None = None
        self._plan: list[list[float]] = []
        self._cut = True
        self._set_numbers(numbers_of(self.base))
        self.restart()
        programs.warm(shield)

    # The visitor's requests.

    def apply(self, message: Message) -> None:
        """Apply a message. **Raises** `MessageError` if that is not possible now."""
        match message:
            case Drive():
                self._drive = message
                if message != Drive() and self.pursuer != YOU:
                    self._pick(Pick(pursuer=YOU))
            case Pause(paused):
                self.paused = paused
            case Step():
                self._single_step()
            case Pace(pace):
                self.pace = pace
            case Reset(again):
                self.restart(again=again)
            case Pick():
                self._pick(message)
            case Numbers():
                self._slide(message)
            case Move():
                self._move(message)
            case Show():
                self.show = message
            case Restore():
                self._restore(message)
            case Seen():
                pass

    def restart(self, *, again: bool = False) -> None:
        """Begin an episode, from a new start or `again` from the last one."""
        if not again:
            seed = int(self._random.integers(2**31))
            self._start = self.programs.starts(self.scenario, seed)
        self._begin({name: part.copy() for name, part in self._start.items()})

    @property
    def ready(self) -> bool:
        """Whether the shield's program is compiled."""
        return self.programs.ready(self.shield)

    @property
    def moving(self) -> bool:
        """Whether the world advances."""
        return self.ready and not self.paused and self.outcome is None

    def settle(self) -> None:
        """Compute whether the certificate holds for new numbers, which takes about 20 ms."""
        self.verdict = verdict(self.numbers, self.period, self.base.pursuer_count)

    @property
    def settled(self) -> bool:
        """Whether the result of `settle` is known."""
        return self.verdict.kind != "unsure"

    # Simulation.

    def advance(self) -> dict[str, Any]:
        """Advance by one control period, if the world moves, and return the frame that shows it."""
        if not self.moving:
            return self.frame()
        begun = {name: np.array(part) for name, part in self._parts.items()}
        self._period()
        return self._frame_of(begun, self.pace)

    def _period(self) -> None:
        program = self.programs[self.shield]
        mode = control.BY_WHEELS if self._drive.toward is None else control.BY_POINT
        vector = program.vector(
            {
                **self._parts,
                "held": self._held,
                "ask": self._count % self.decision_steps == 0,
                "strategy": control.STRATEGIES.index("nash" if self.pursuer == YOU else self.pursuer),
                "mode": mode if self.pursuer == YOU else control.BY_STRATEGY,
                "command": self._drive.toward or self._drive.wheels or (0.0, 0.0),
                "count": self._count % 2**20,
                "renew": self._waited + self.period > PATIENCE,
                "draws": self._random.uniform(-1.0, 1.0, (TRIES, 2)),
            }
        )
        if self._memory is None:
            self._memory = program.begin(self._arrays, vector)
        if self.show.plan and program.plans and self._count % _PLAN_EVERY == 0:
            looking = self._output is not None and self._output["looking"] > 0.0
            self._plan = _rounded(program.plan(self._arrays, vector, self._memory)) if looking else []
        result, self._memory = program.step(self._arrays, vector, self._memory)
        output = self._output = program.outputs.split(np.asarray(result, np.float64))
        self._recording.add(vector[: program.place.size], result)
        self._parts = {name: output[name] for name in program.place.shapes}
        self._parts |= {"target": output["next_target"], "obstacles": output["turned"]}
        self._held, self._count = output["nominal"], self._count + 1
        self.score.lasted(self.shield, self.period)
        self._judge(output)

    def _judge(self, output: dict[str, Any]) -> None:
        tally = self.score.of(self.shield)
        if output["captured"] > 0.0:
            self.outcome = "captured"
            tally.captured += 1
        elif output["collided"] > 0.0:
            self.outcome = "collided"
            tally.collided += 1
        elif output["reached"] > 0.0:
            tally.reached += 1
        self._waited += self.period
        if output["reached"] > 0.0 or self._waited > PATIENCE:
            self._waited = 0.0

    # Changes of the world by messages.

    def _begin(self, parts: dict[str, Any]) -> None:
        """Continue from these parts of a new world."""
        self._parts = parts
        self._held, self._count = np.zeros(2), 0
        self.outcome, self._output, self._plan, self._waited = None, None, [], 0.0
        self.score.restart()
        self._break()

    def _break(self) -> None:
        """Reset the shield's memory and the recording after a discontinuity of the world."""
        self._memory, self._cut = None, True
        self._recording.restart()

    def _pick(self, pick: Pick) -> None:
        if pick.shield is not None and pick.shield != self.shield:
            self.shield = pick.shield
            self.programs.warm(pick.shield)
            self.score.restart()
            self._break()
        if pick.pursuer is not None and pick.pursuer != self.pursuer:
            self.pursuer = pick.pursuer
            self.score.restart()

    def _set_numbers(self, numbers: dict[str, float]) -> None:
        self.numbers = numbers
        self.scenario = with_numbers(self.base, numbers)
        self._arrays = traced(self.scenario, self.programs.policy)
        self.verdict = quick_verdict(numbers, self.period)

    def _slide(self, message: Numbers) -> None:
        before = numbers_of(self.base) if message.defaults else self.numbers
        numbers = {**before, **message.values}
        if numbers == self.numbers:
            return
        faster = numbers["obstacle_speed"] != self.numbers["obstacle_speed"]
        self._set_numbers(numbers)
        if faster:
            obstacles = self._parts["obstacles"].copy()
            obstacles[:, 2:] = np.asarray(drifts_at(obstacles[:, 2:], numbers["obstacle_speed"]))
            self._parts["obstacles"] = obstacles
        if self._touching():
            self.restart()
            return
        self.score.restart()
        self._break()

    def _touching(self) -> bool:
        """Whether the robot is captured or collides in the current world."""
        return bool(is_touching(self.scenario, World(**{name: real(v) for name, v in self._parts.items()})))

    def _move(self, message: Move) -> None:
        if not self.paused:
            raise MessageError("pause first, then drag")
        parts = {name: part.copy() for name, part in self._parts.items()}
        if message.what in ("evader", "target"):
            parts[message.what] = np.array(message.to)
        else:
            robot = parts[f"{message.what}s"][message.index]
            robot[:2] = message.to
            if message.heading is not None and message.what == "pursuer":
                robot[2] = (message.heading + np.pi) % (2.0 * np.pi) - np.pi
        self._start = {name: part.copy() for name, part in parts.items()}
        self._start["time"] = np.zeros(())
        self._begin(parts)

    def _restore(self, message: Restore) -> None:
        self._slide(Numbers(message.values, defaults=True))
        self._pick(Pick(message.shield, message.pursuer))
        if message.scene is None:
            return
        scene = message.scene
        parts = {
            "evader": np.array(scene.evader[0]),
            "pursuers": np.array(scene.pursuers, float).reshape(-1, 3),
            "obstacles": np.array(scene.obstacles, float).reshape(-1, 4),
            "target": np.array(scene.target[0]),
            "time": np.zeros(()),
            "evader_velocity": np.zeros(2),
            "wheel_speeds": np.zeros((self.base.pursuer_count, 2)),
        }
        self._start = {name: part.copy() for name, part in parts.items()}
        self._begin(parts)

    def _single_step(self) -> None:
        if self.ready and self.paused and self.outcome is None:
            self._period()

    @property
    def decision_steps(self) -> int:
        """Control periods between two decisions of the policy."""
        return int(getattr(self.programs.policy, "decision_steps", 1))

    # Data sent to the visitor.

    def frame(self) -> dict[str, Any]:
        """The current world, with the commands of the last period."""
        return self._frame_of(self._parts, 0.0)

    def _frame_of(self, parts: dict[str, Any], pace: float) -> dict[str, Any]:
        """The world at the beginning of a period and the commands held in it; with `pace` 0 it stands still.

        From these the page computes every robot's exact motion until the next frame.
        """
        self.frame_number += 1
        output = self._output
        frame: dict[str, Any] = {
            "type": "frame",
            "frame": self.frame_number,
            "pace": pace,
            "cut": self._cut,
            "time": round(float(parts["time"]), 4),
            "evader": _rounded(parts["evader"]),
            "pursuers": _rounded(parts["pursuers"]),
            "obstacles": _rounded(parts["obstacles"]),
            "target": _rounded(parts["target"]),
            "over": self.outcome,
            "score": self.score.to_dict(),
        }
        self._cut = False
        if output is not None:
            frame |= {
                "action": _rounded(output["action"]),
                "nominal": _rounded(np.nan_to_num(output["nominal"])),
                "wheels": _rounded(output["wheels"]),
                "h": _rounded(output["h"]),
                "barriers": _rounded(np.nan_to_num(output["barriers"], neginf=0.0)),
                "intervention": round(float(output["intervention"]), 5),
                "status": Status.NAMES[int(output["status"])],
                "reached": bool(output["reached"] > 0.0),
                "looking": bool(output["looking"] > 0.0),
            }
            if self.show.rows:
                frame["rows"] = _rounded(np.column_stack([output["normals"], output["offsets"]]))
            if self.show.plan:
                frame["plan"] = self._plan
        return frame

    def setup(self) -> dict[str, Any]:
        """The visitor's choices and the resulting verdict; sent when they change."""
        return {
            "type": "setup",
            "shield": self.shield,
            "pursuer": self.pursuer,
            "paused": self.paused,
            "pace": self.pace,
            "numbers": self.numbers,
            "verdict": self.verdict.to_dict(),
            "states": self.programs.states,
            "ready": self.ready,
            "show": {"rows": self.show.rows, "plan": self.show.plan},
        }

    def record(self) -> tuple[Recording, tuple[np.ndarray, np.ndarray], Scenario, dict[str, Any]]:
        """The recording of this episode, its scenario, and its metadata."""
        about = {"shield": self.shield, "pursuer": self.pursuer, "source": "sidestep play"}
        return self._recording, self._recording.copy(), self.scenario, about


def _rounded(values: Any) -> Any:
    return np.round(np.asarray(values, float), 5).tolist()
