"""Checkpoints: the complete training state as plain arrays, written whole or not at all.

A checkpoint is one `.npz` file of named arrays without pickled objects, with a digest of its content. A kill
at any time leaves the previous one intact. Only the filled part of the replay is stored.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import warnings
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from sidestep.store.damage import DamageWarning
from sidestep.store.files import write_bytes
from sidestep.store.runs import RunError

_NAME = re.compile(r"episodes-(\d+)\.npz")
_KEPT = 2
_MANIFEST = "manifest"
Tree = TypeVar("Tree")


class CheckpointError(RunError):
    """An unusable checkpoint: damaged, or of a different training."""


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return [(jax.tree_util.keystr(path), leaf) for path, leaf in leaves]


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _rows_of(name: str, rows: dict[str, int]) -> int | None:
    for prefix, count in rows.items():
        if name == prefix or name.startswith(prefix + "."):
            return count
    return None


def _digest(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}:{array.dtype.str}:{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def write_arrays(
    path: Path, tree: Any, *, rows: dict[str, int] | None = None, compressed: bool = False, **about: Any
) -> None:
    """Write a pytree of arrays and the metadata `about`, whole or not at all.

    Of leaves at or below a name in `rows` only that many leading rows are stored. On reading, the other rows
    are taken from the example, which may have more rows than the stored tree.
    """
    rows = rows or {}
    arrays = {name: _plain(leaf)[: _rows_of(name, rows)] if _rows_of(name, rows) is not None else _plain(leaf)
              for name, leaf in _named_leaves(tree)}  # fmt: skip
    manifest = json.dumps({**about, "digest": _digest(arrays), "rows": rows})
    buffer = io.BytesIO()
    stored: dict[str, Any] = {_MANIFEST: np.frombuffer(manifest.encode(), np.uint8), **_slots(arrays)}
    (np.savez_compressed if compressed else np.savez)(buffer, **stored)
    write_bytes(path, buffer.getvalue())


def _slots(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    # Pytree paths are bad file names inside a zip, so arrays are numbered and the names stored separately.
    names = np.frombuffer(json.dumps(list(arrays)).encode(), np.uint8)
    return {"names": names, **{f"leaf{i}": array for i, array in enumerate(arrays.values())}}


def read_named(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays by pytree path, and the manifest. **Raises** `CheckpointError` when the file is damaged."""
    try:
        # From memory, because NumPy leaves an invalid file open.
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            manifest = json.loads(bytes(file[_MANIFEST]))
            names = json.loads(bytes(file["names"]))
            arrays = {name: file[f"leaf{i}"] for i, name in enumerate(names)}
    except FileNotFoundError:
        raise CheckpointError(f"{path} does not exist") from None
    except Exception as error:
        # A damaged file may cause any exception of NumPy, zip or JSON.
        raise CheckpointError(f"{path} is damaged: {error or type(error).__name__}") from None
    if _digest(arrays) != manifest.get("digest"):
        raise CheckpointError(f"{path} is damaged: its digest differs from its content's")
    return arrays, manifest


def read_arrays(path: Path, example: Tree) -> tuple[Tree, dict[str, Any]]:
    """The pytree of `write_arrays`, with the shapes of `example`, and its metadata.

    **Raises** `CheckpointError` when the file is damaged or does not match `example`.
    """
    arrays, manifest = read_named(path)
    tree = _filled(path, arrays, manifest["rows"], example)
    if arrays:
        raise CheckpointError(f"{path} holds {', '.join(list(arrays)[:3])} that this version does not know")
    return tree, manifest


def _filled(
    path: Path, arrays: dict[str, np.ndarray], rows: dict[str, int], example: Tree, at: str = ""
) -> Tree:
    """The part of a stored pytree at the name `at`, with the shapes of `example`; takes its arrays out."""
    leaves = []
    for name, leaf in ((at + name, leaf) for name, leaf in _named_leaves(example)):
        wanted = _plain(leaf)
        if name not in arrays:
            raise CheckpointError(
                f"{path} lacks {name}: it was written by another version or with other options"
            )
        array = arrays.pop(name)
        if _rows_of(name, rows) is not None and array.shape[1:] == wanted.shape[1:]:
            array = np.concatenate([array, wanted[len(array) :]])
        if array.shape != wanted.shape or array.dtype != wanted.dtype:
            raise CheckpointError(
                f"{path}: {name} is {array.dtype}{list(array.shape)}, but {wanted.dtype}"
                f"{list(wanted.shape)} is needed: it was written with another scenario, other options or "
                "another float precision"
            )
        value = jnp.asarray(array)
        if _is_key(leaf):
            value = jax.random.wrap_key_data(value, impl=jax.random.key_impl(leaf))
        leaves.append(value)
    return jax.tree.unflatten(jax.tree.structure(example), leaves)


def write_checkpoint(folder: str | Path, state: Any, *, wall_seconds: float) -> Path:
    """Write the training state as the newest checkpoint; the two newest are kept."""
    folder = Path(folder) / "checkpoints"
    ended = np.asarray(state.episodes)
    episodes = int(ended.sum())
    folder.mkdir(exist_ok=True)
    path = folder / f"episodes-{episodes:06d}.npz"
    filled = min(int(state.replay.written), state.replay.capacity)
    write_arrays(
        path,
        state,
        rows={
            ".replay.transitions": filled,
            ".replay.episode": filled,
            ".replay.episode_last": min((int(ended.max()) + 1) * ended.size, state.replay.capacity),
        },
        episodes=episodes,
        wall_seconds=wall_seconds,
    )
    for old in list_checkpoints(folder.parent)[:-_KEPT]:
        old.unlink(missing_ok=True)
    return path


def list_checkpoints(folder: str | Path) -> list[Path]:
    """Checkpoints of a run, oldest first."""
    found = [path for path in (Path(folder) / "checkpoints").glob("*.npz") if _NAME.fullmatch(path.name)]
    return sorted(found, key=_episodes_of)


def read_part(folder: str | Path, part: str, example: Tree) -> Tree:
    """One part of the training state in the newest valid checkpoint of a run, such as `"learner"`.

    **Raises** `CheckpointError` when no checkpoint is valid, or the part does not match `example`.
    """
    problem: CheckpointError | None = None
    for path in reversed(list_checkpoints(folder)):
        try:
            arrays, manifest = read_named(path)
        except CheckpointError as error:
            problem = problem or error
            continue
        return _filled(path, arrays, manifest["rows"], example, f".{part}")
    raise problem or CheckpointError(f"{folder} has no checkpoint")


def _episodes_of(path: Path) -> int:
    return int(_NAME.fullmatch(path.name).group(1))  # type: ignore[union-attr]


def read_checkpoint(folder: str | Path, example: Tree) -> tuple[Tree, dict[str, Any]]:
    """The newest valid checkpoint of a run.

    Damaged checkpoints are skipped, with a `DamageWarning` that names the file, the episode from which the
    run continues, and what was lost.

    **Raises** `CheckpointError` when there is none, or none that matches `example`.
    """
    problems: list[CheckpointError] = []
    for path in reversed(list_checkpoints(folder)):
        try:
            found = read_arrays(path, example)
        except CheckpointError as error:
            problems.append(error)
            continue
        if problems:
            begin, lost = _episodes_of(path), _episodes_of(list_checkpoints(folder)[-1]) - _episodes_of(path)
            warnings.warn(
                f"{'; '.join(map(str, problems))}. The training goes on from {path.name}, after episode "
                f"{begin}. Lost: the {lost} episodes after it, which are trained again (the same seed gives "
                "the same episodes)",
                DamageWarning,
                stacklevel=2,
            )
        return found
    if not problems:
        raise CheckpointError(f"{folder} has no checkpoint any more; start another run with --out")
    if len(problems) > 1:
        raise CheckpointError(
            f"{'; '.join(map(str, problems))}. No older checkpoint is left: start another run with --out"
        )
    raise problems[0]
