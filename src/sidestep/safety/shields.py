"""Shields: from the action a policy would take to the action a robot may take, with a status."""

import abc
import functools
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sidestep._arrays import AnyArray, apart, fold, lane_by_lane, stack
from sidestep.safety.barriers import (
    Barrier,
    BarrierRows,
    ObstacleBarrier,
    RangeBarrier,
    compose,
)
from sidestep.safety.budget import Budget
from sidestep.safety.filter import project, project_known
from sidestep.safety.going_round import next_turn, still_turned, turned
from sidestep.safety.least_violation import root
from sidestep.safety.pursuit_barrier import PursuitBarrier
from sidestep.safety.sampling_margin import guarded, margins, sampling_margin
from sidestep.safety.status import Status
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


class ShieldResult(eqx.Module):
    """What a shield decided.

    - `action (2,)` the velocity to execute, m/s in world axes; always finite and within the speed limit
    - `status` see `Status`
    - `barriers (m + k,)` h in m, pursuers first; -inf where the world was not finite
    - `slack` m/s by which the action keeps the tightest row (negative: violates); +inf without rows
    - `intervention` |action - nominal|, m/s, see `correction`
    """

    action: Float[Array, "2 *lanes"]
    status: Int[Array, "*lanes"]
    barriers: Float[Array, "n *lanes"]
    slack: Float[Array, "*lanes"]
    intervention: Float[Array, "*lanes"]


class Shield(eqx.Module):
    """A shield for one scenario. `memory = shield.init(world)`; then one call per control period.

    The scenario's gains, speeds and distances are traced: other values never recompile.
    """

    scenario: eqx.AbstractVar[Scenario]

    @property
    def rows_only(self) -> "Shield":
        """The shield to learn through: its rows, whose derivatives say how the executed action follows the
        nominal one, without anything that is costly and has none. The shield itself if it is all rows."""
        return self

    @property
    def looks_ahead(self) -> bool:
        """Whether it does more than rows, so that a decision costs thousands of times as much."""
        return self.rows_only is not self

    @property
    def takes_lanes(self) -> bool:
        """Whether it takes many worlds in lanes; others are asked for each (`filter_in_lanes`)."""
        return False

    @abc.abstractmethod
    def init(self, world: World) -> Any:
        """The memory (a pytree) at the start of an episode."""

    @abc.abstractmethod
    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        """Filter the nominal velocity (m/s, world axes).

        **Returns** the `ShieldResult` and the memory for the next call. Non-finite input (a nominal
        action, a pose) gives `Status.INVALID` and an action as close to a stop as the rest allows.
        """


def start_in_lanes(shield: Any, world: World) -> Any:
    """`shield.init` for one world or for many in lanes, whatever the shield takes."""
    if getattr(shield, "takes_lanes", False):
        return shield.init(world)
    return lane_by_lane(shield.init, world.lanes, world)


def filter_in_lanes(
    shield: Any, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
) -> tuple[Any, Any]:
    """The shield's answer for one world or for each of many in lanes, whatever the shield takes."""
    if not world.lanes:
        return shield(world, nominal, memory)
    if getattr(shield, "takes_lanes", False):
        return apart(shield, world, nominal, memory)
    return lane_by_lane(shield, world.lanes, world, nominal, memory)


def _known(world: World) -> Bool[Array, "n *lanes"]:
    """Per pursuer and obstacle: whether it and the evader are where numbers say.

    Asked of the world itself, because a NaN can vanish on its way into a row: every comparison with it is
    false, and a `where` then takes the other case.
    """
    evader = _finite(world.evader)
    return jnp.concatenate([_finite(group, 1) & evader for group in (world.pursuers, world.obstacles)])


def _finite(components: Float[AnyArray, "..."], axis: int = 0) -> Bool[Array, "..."]:
    parts = (jax.lax.index_in_dim(components, i, axis, False) for i in range(components.shape[axis]))
    return functools.reduce(jnp.logical_and, map(jnp.isfinite, parts))


def decide(
    scenario: Scenario,
    world: World,
    nominal: Float[AnyArray, "2 *lanes"],
    rows: BarrierRows,
    *,
    enforced: bool,
    hard: int,
    known: Bool[Array, "n *lanes"] | None = None,
) -> ShieldResult:
    """The answer of a shield whose rows these are: the first `hard` of them before the others, none at all
    unless `enforced`. `known` says of each whether it speaks of finite numbers; None asks the world."""
    nominal = jnp.asarray(nominal, rows.values.dtype)
    known = _known(world) if known is None else known
    known &= jnp.isfinite(rows.values)
    if enforced:
        known &= jnp.isfinite(rows.offsets) & _finite(rows.normals, 1)
    finite = _finite(nominal)
    everything = fold(jnp.logical_and, known, True)
    # With part of the world unknown nothing vouches for the nominal action.
    vouched = stack(*(jnp.where(everything, component, 0.0) for component in nominal))
    count = rows.offsets.shape[0] if enforced else 0
    projection = project(
        vouched,
        rows.normals[:count],
        jnp.where(known, rows.offsets, jnp.nan)[:count],
        scenario.evader_speed,
        hard=hard if enforced else 0,
        circle=scenario.action == "heading",
    )
    status = jnp.where(everything, projection.status, Status.INVALID).astype(projection.status.dtype)
    return ShieldResult(
        action=projection.action,
        status=status,
        barriers=jnp.where(known, rows.values, -jnp.inf),
        slack=projection.slack,
        intervention=correction(projection.action, jnp.where(finite, nominal, 0.0)),
    )


def correction(
    action: Float[AnyArray, "2 *lanes"], nominal: Float[AnyArray, "2 *lanes"]
) -> Float[Array, "*lanes"]:
    """|action - nominal| in m/s, for components of `nominal` up to 1e15 m/s; larger ones count as that.

    Beyond, the square of a command, and so every sum of corrections, would be infinite.
    """
    x, y = (new - jnp.clip(old, -1e15, 1e15) for new, old in zip(action, nominal, strict=True))
    return root(x * x + y * y)


def as_turned(
    result: ShieldResult, nominal: Float[AnyArray, "2 *lanes"], turn: Float[AnyArray, "*lanes"]
) -> ShieldResult:
    """The answer for a nominal action that was turned aside, as one for the `nominal` action itself."""
    aside = turn != 0.0
    moved = correction(result.action, jnp.where(_finite(nominal), nominal, 0.0))
    return eqx.tree_at(
        lambda result: (result.status, result.intervention),
        result,
        (
            jnp.where(aside, jnp.maximum(result.status, Status.CORRECTED), result.status),
            jnp.where(aside, moved, result.intervention),
        ),
    )


def _with_obstacles(
    barrier: Barrier, scenario: Scenario, world: World, memory: Float[Array, "m *lanes"]
) -> BarrierRows:
    """Rows towards all pursuers, then towards all obstacles."""
    obstacle = ObstacleBarrier()
    towards_pursuers = barrier.rows(scenario, world, memory)
    return compose(towards_pursuers, obstacle.rows(scenario, world, obstacle.remember(scenario, world)))


@final
class NoShield(Shield):
    """Executes the nominal action as it is, cut to the speed limit; reports distances as barriers.

    Status `OK` or `CORRECTED` (by the speed limit), or `INVALID` and a stop for a non-finite action or
    world.
    """

    scenario: Scenario

    @property
    def takes_lanes(self) -> bool:
        return True

    def init(self, world: World) -> Any:
        return RangeBarrier().remember(self.scenario, world)

    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        rows = _with_obstacles(RangeBarrier(), self.scenario, world, memory)
        return decide(self.scenario, world, nominal, rows, enforced=False, hard=0), memory


@final
class PaperShield(Shield):
    """The paper's shield: `RangeBarrier` towards pursuers, `ObstacleBarrier` towards obstacles.

    Kept as the baseline. Its pursuer row cannot always be kept (see `RangeBarrier`); then the answer
    violates the pursuers' rows least, and the obstacles' rows least after that.
    """

    scenario: Scenario

    @property
    def takes_lanes(self) -> bool:
        return True

    def init(self, world: World) -> Any:
        return RangeBarrier().remember(self.scenario, world)

    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        rows = _with_obstacles(RangeBarrier(), self.scenario, world, memory)
        hard = self.scenario.pursuer_count
        return decide(self.scenario, world, nominal, rows, enforced=True, hard=hard), memory


class GameMemory(eqx.Module):
    """What `game` keeps in mind: the `sides (m,)` of the pursuers' axes that its rows follow, and the
    `turn ()` that leads it round an obstacle, see `going_round`."""

    sides: Float[Array, "m *lanes"]
    turn: Float[Array, "*lanes"]


@final
class GameShield(Shield):
    """`PursuitBarrier` towards pursuers, kept before the `ObstacleBarrier` rows when not all can hold.

    Against one pursuer in the unbounded plane, in continuous time and with l <= l_max, the pursuit row can
    always be kept, and then there is no capture. Sampling, several pursuers and obstacles beside them are
    outside that statement. For the pursuer's turns within a period the rows keep `sampling_margin` more than
    the capture distance; the barriers that are reported are those of the capture distance itself.

    `known_velocity=True` is for a pursuer whose next wheel speeds are known, because it announces them or
    they can be computed: whoever calls puts them into `world.wheel_speeds`. The rows are then those of
    `PursuitBarrier.rows_over_period`, two for each pursuer, which need no margin and interfere less.

    `wish_picks_side=True` lets the nominal action choose the side of a pursuer's axis where either will do,
    see `PursuitBarrier.prefer`.

    With a `budget` the rows also keep what measurement, delay and motors may take, see `Budget`. One that is
    more than the game leaves is kept as well as can be, as everything that cannot: the further out the rows
    begin to ask for retreat, the closer the distance stays to the best that is possible.

    With `goes_round=True`, which `make_shield` sets, an evader that is stuck behind an obstacle goes round it
    (see `going_round`): rows and filter stay as they are, the nominal action is turned aside for a while.
    Where the scenario has obstacles the memory is then a `GameMemory`, else only its `sides`.
    """

    scenario: Scenario
    budget: Budget | None = None
    known_velocity: bool = eqx.field(static=True, default=False)
    wish_picks_side: bool = eqx.field(static=True, default=False)
    goes_round: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        if self.known_velocity and self.budget is not None:
            raise ValueError("the rows for a known velocity keep no budget; leave out one of the two")

    @property
    def takes_lanes(self) -> bool:
        return not self.known_velocity

    def init(self, world: World) -> Any:
        sides = PursuitBarrier().remember(self.scenario, world)
        return GameMemory(sides, jnp.zeros_like(world.evader[0])) if self._may_be_stuck else sides

    @property
    def _may_be_stuck(self) -> bool:
        return self.goes_round and self.scenario.obstacle_count > 0

    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        if not self._may_be_stuck:
            return self._filtered(world, nominal, memory)
        kept = guarded(self.scenario, self.budget)
        nominal = jnp.asarray(nominal, world.evader.dtype)
        turn = still_turned(kept, world, nominal, memory.turn)
        result, sides = self._filtered(world, turned(nominal, turn), memory.sides)
        result = as_turned(result, nominal, turn)
        towards_pursuers = result.barriers[: self.scenario.pursuer_count]
        turn = next_turn(kept, world, nominal, result.action, turn, towards_pursuers)
        turn = jnp.where(result.status == Status.INVALID, 0.0, turn)
        return result, GameMemory(sides, turn.astype(memory.turn.dtype))

    def _filtered(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        if self.known_velocity:
            return self._over_period(world, nominal, memory)
        m = self.scenario.pursuer_count
        rows, memory = self._kept_rows(world, nominal, memory)
        towards_pursuers, towards_obstacles = margins(self.scenario, self.budget)
        values = jnp.concatenate([rows.values[:m] + towards_pursuers, rows.values[m:] + towards_obstacles])
        rows = eqx.tree_at(lambda rows: rows.values, rows, values)
        return decide(self.scenario, world, nominal, rows, enforced=True, hard=m), memory

    def _kept_rows(self, world: World, wish: Any, memory: Any) -> tuple[BarrierRows, Any]:
        """The rows at the distances that are kept, and the sides of the pursuers' axes that they follow."""
        # Where the margin has been used up the row still holds what is left, and asks for no more. Not so
        # with the budget's: errors push inwards again and again, and the row leads back out.
        barrier = PursuitBarrier(eased=sampling_margin(self.scenario), budget=self.budget)
        kept = guarded(self.scenario, self.budget)
        if self.wish_picks_side:
            memory = barrier.prefer(kept, world, memory, wish)
        else:
            memory = barrier.remember(kept, world, memory)
        rows = _with_obstacles(barrier, kept, world, memory)
        if self.budget is None:
            return rows, memory
        offsets = rows.offsets + self.budget.tracking_error
        return eqx.tree_at(lambda rows: rows.offsets, rows, offsets), memory

    def heed(
        self, world: World, wish: Float[Array, "2 *lanes"], memory: Float[Array, "m *lanes"]
    ) -> tuple[Float[Array, "2 *lanes"], Float[Array, "m *lanes"]]:
        """The action (m/s) alone, and the next memory, for a finite world and a wish within the speed limit.

        The same as calling the shield, without what it takes to be sure of its input and to report: for
        chases that are only imagined.
        """
        rows, memory = self._kept_rows(world, wish, memory)
        action = project_known(
            wish,
            rows.normals,
            rows.offsets,
            self.scenario.evader_speed,
            hard=self.scenario.pursuer_count,
            circle=self.scenario.action == "heading",
        )
        return action, memory

    def _over_period(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        barrier, obstacle, m = PursuitBarrier(), ObstacleBarrier(), self.scenario.pursuer_count
        memory = barrier.remember(self.scenario, world, memory)
        rows = compose(
            barrier.rows_over_period(self.scenario, world, memory),
            obstacle.rows(self.scenario, world, obstacle.remember(self.scenario, world)),
        )
        known = _known(world)
        result = decide(
            self.scenario,
            world,
            nominal,
            rows,
            enforced=True,
            hard=2 * m,
            known=jnp.concatenate([jnp.repeat(known[:m], 2), known[m:]]),
        )
        once = jnp.concatenate([result.barriers[: 2 * m : 2], result.barriers[2 * m :]])
        return eqx.tree_at(lambda result: result.barriers, result, once), memory
