"""The trained policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any, final

import equinox as eqx
import jax
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, real
from sidestep.learning.networks import Actor
from sidestep.learning.players import LearnedPursuer
from sidestep.pursuit import CHAUFFEURS, MIXTURES, PURSUERS, Mixed, Pursuer, make_pursuer
from sidestep.store.checkpoints import read_arrays, read_named, write_arrays
from sidestep.store.runs import RunError, open_run

_FILE = "policy.npz"
PRETRAINED = "pretrained"
"""The name of the policy that comes with the package, for preset `paper` with `observation="motion"`."""
HUNTER = "hunter"
"""The name of the pursuer that comes with the package, for scenarios with one obstacle: it learned against
`pretrained`."""
PRETRAINED_SCENARIO = {"observation": "motion"}
"""The fields of preset `paper` that were changed for its training."""


@final
class LearnedPolicy(eqx.Module):
    """A trained actor: observation to action in [-1, 1]^2, once every `decision_steps` control periods."""

    actor: Actor
    decision_steps: int = eqx.field(static=True)

    def __call__(self, observation: Float[AnyArray, "observation"]) -> Float[Array, "2"]:
        """**Raises** as `check_shape`."""
        self.check_shape(observation.shape)
        return self.actor(real(observation)[None])[0]

    def check_shape(self, shape: tuple[int, ...]) -> None:
        """**Raises** `ValueError` unless the policy was trained on observations of this shape."""
        wanted = self.actor.body.weights[0].shape[0]
        if shape != (wanted,):
            raise ValueError(
                f"this policy was trained on observations of {wanted} entries, this scenario has "
                f"{shape[-1]}: use the frame, observation, pursuer_count and obstacle_count of its training"
            )


def write_policy(folder: str | Path, policy: LearnedPolicy | LearnedPursuer) -> Path:
    """Write the policy of a run, or the pursuer that it has trained, as `policy.npz`."""
    path = Path(folder) / _FILE
    weights = policy.actor.body.weights
    sizes = [int(weights[0].shape[0]), *(int(weight.shape[1]) for weight in weights)]
    player: dict[str, Any] = {"player": "pursuer"} if isinstance(policy, LearnedPursuer) else {}
    write_arrays(path, policy.actor, sizes=sizes, decision_steps=policy.decision_steps, **player)
    return path


def policy_file(run: str | Path) -> Path:
    """The file of a policy.

    **Arguments:** `run`, a run folder, a `policy.npz` file, or `"pretrained"` or `"hunter"` for the policy
    and the pursuer that come with the package; a folder of that name is `./pretrained`.

    **Raises** `RunError` when the folder holds no run or its training has not ended.
    """
    if run in (PRETRAINED, HUNTER):
        return Path(__file__).with_name(f"{run}.npz")
    path = Path(run)
    if path.suffix != ".npz":
        open_run(path, otherwise="name a run folder, or the policy.npz in it")
        path = path / _FILE
        if not path.is_file():
            raise RunError(f"{run} has no policy yet: its training has not ended; continue it with --resume")
    return path


def load_trained(run: str | Path) -> LearnedPolicy | LearnedPursuer:
    """What a run has trained. **Raises** as `policy_file`, and `CheckpointError` when the file is damaged."""
    path = policy_file(run)
    _, manifest = read_named(path)
    observations, *hidden, actions = manifest["sizes"]
    example = Actor(observations, actions, tuple(hidden), jax.random.key(0))
    actor, manifest = read_arrays(path, example)
    kind = LearnedPursuer if manifest.get("player") == "pursuer" else LearnedPolicy
    return kind(actor, int(manifest["decision_steps"]))


def load_policy(run: str | Path) -> LearnedPolicy:
    """Read the policy of a run folder, of a `policy.npz` file, or `"pretrained"`; see `policy_file`.

    **Raises** as `load_trained`, and `RunError` when the run has trained a pursuer.
    """
    policy = load_trained(run)
    if isinstance(policy, LearnedPursuer):
        raise RunError(f"{run} has trained a pursuer, not a policy for the evader: it goes with --pursuer")
    return policy


def load_pursuer(name: str | Path) -> Pursuer:
    """The pursuer of that name, of a run folder that has trained one, or a mixture of several.

    **Arguments:** `name` as for `make_pursuer`, or `hunter`, the one that comes with the package, or a run
    folder or its `policy.npz`, or several of these joined by `+`, such as `nash+interceptor+runs/mine`: one
    after another, drawn anew every 20 s.

    **Raises** `ValueError` for an unknown name or one that cannot be mixed, and as `load_trained`.
    """
    names = str(name).split("+")
    pursuers = [_pursuer(one) for one in names]
    if len(pursuers) == 1:
        return pursuers[0]
    strategies: list[Pursuer] = []
    for one, pursuer in zip(names, pursuers, strict=True):
        strategies += pursuer.strategies if isinstance(pursuer, Mixed) else [pursuer]
        if not strategies[-1].takes_lanes:
            raise ValueError(f"pursuer {one} cannot be mixed: it draws random numbers; mixed has its like")
    return Mixed(tuple(strategies))


def from_anywhere(names: str) -> str:
    """The names of policies or pursuers, joined by `+`, with absolute paths for those that are paths."""
    shipped = {PRETRAINED, HUNTER, *PURSUERS, *CHAUFFEURS, *MIXTURES}
    whole = [
        str(Path(name).absolute()) if name not in shipped and Path(name).exists() else name
        for name in names.split("+")
    ]
    return "+".join(whole)


def _pursuer(name: str) -> Pursuer:
    known = PURSUERS | CHAUFFEURS | MIXTURES
    if name != HUNTER and (name in known or not Path(name).exists()):
        try:
            return make_pursuer(name)
        except ValueError as error:
            raise ValueError(f"{error}, {HUNTER}; nor is there a run folder {name}") from None
    pursuer = load_trained(name)
    if isinstance(pursuer, LearnedPolicy):
        raise RunError(f"{name} has trained a policy for the evader, not a pursuer: train one with --against")
    return pursuer
