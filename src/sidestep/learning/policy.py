"""The trained policy."""

from __future__ import annotations

from pathlib import Path
from typing import final

import equinox as eqx
import jax
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, real
from sidestep.learning.networks import Actor
from sidestep.store.checkpoints import read_arrays, read_named, write_arrays
from sidestep.store.runs import RunError, open_run

_FILE = "policy.npz"
PRETRAINED = "pretrained"
"""The name of the policy that comes with the package, for preset `paper` with `observation="motion"`."""
_SHIPPED = Path(__file__).with_name("pretrained.npz")
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


def write_policy(folder: str | Path, policy: LearnedPolicy) -> Path:
    """Write the policy of a run as `policy.npz`."""
    path = Path(folder) / _FILE
    weights = policy.actor.body.weights
    sizes = [int(weights[0].shape[0]), *(int(weight.shape[1]) for weight in weights)]
    write_arrays(path, policy.actor, sizes=sizes, decision_steps=policy.decision_steps)
    return path


def policy_file(run: str | Path) -> Path:
    """The file of a policy.

    **Arguments:** `run`, a run folder, a `policy.npz` file, or `"pretrained"` for the policy that comes with
    the package; a folder of that name is `./pretrained`.

    **Raises** `RunError` when the folder holds no run or its training has not ended.
    """
    if run == PRETRAINED:
        return _SHIPPED
    path = Path(run)
    if path.suffix != ".npz":
        open_run(path, otherwise="name a run folder, or the policy.npz in it")
        path = path / _FILE
        if not path.is_file():
            raise RunError(f"{run} has no policy yet: its training has not ended; continue it with --resume")
    return path


def load_policy(run: str | Path) -> LearnedPolicy:
    """Read the policy of a run folder, of a `policy.npz` file, or `"pretrained"`; see `policy_file`.

    **Raises** as `policy_file`, and `CheckpointError` when the file is damaged.
    """
    path = policy_file(run)
    _, manifest = read_named(path)
    observations, *hidden, actions = manifest["sizes"]
    example = Actor(observations, actions, tuple(hidden), jax.random.key(0))
    actor, manifest = read_arrays(path, example)
    return LearnedPolicy(actor, int(manifest["decision_steps"]))
