"""From a traced JAX function to a `Program`: one rule for each primitive.

What depends on constants only is computed by JAX. Every other value is an array of nodes. A dimension of
`LONG` or more is not written out but becomes a loop: its values are nodes that change with the loop's
counter. Slices, transpositions and the like cost nothing, they only arrange nodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, no_type_check

import jax
import numpy as np
from jax.extend import core, source_info_util

from sidestep.bridges.export.program import KINDS, Node, NotTranslatable, Program, Stored, kind_of
from sidestep.bridges.export.random_rules import RandomRules

LONG = 24
"""Entries from which on a dimension becomes a loop."""
_MOST_STEPS = 32
"""Steps of a `fori_loop` up to which it is written out."""


Nodes: TypeAlias = Any
"""A NumPy array of `Node`s."""


class Looped:
    """An array with one dimension as a loop: `nodes` has the others, `axis` is where it would be."""

    def __init__(self, nodes: Nodes, axis: int, size: int):
        self.nodes, self.axis, self.size = nodes, axis, size

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the whole array."""
        shape = list(self.nodes.shape)
        shape.insert(self.axis, self.size)
        return tuple(shape)


def translate(program: Program, function: Callable[..., Any], inputs: Sequence[Nodes]) -> list[Nodes]:
    """What `function` returns for arrays of nodes, as arrays of nodes.

    **Raises** `NotTranslatable`.
    """
    examples = [
        jax.ShapeDtypeStruct(array.shape, KINDS[array.reshape(-1)[0].kind] if array.size else np.float32)
        for array in inputs
    ]
    traced = jax.make_jaxpr(function)(*examples)
    translator = _Translator(program)
    results = translator.run(traced.jaxpr, traced.consts, list(inputs))
    return [translator.written_out(value) for value in results]


def _is_known(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype != object


@no_type_check  # called millions of times: checking types would take the tests a minute
class _Translator(RandomRules):
    def __init__(self, program: Program):
        self.program = program
        self.where = "an unknown line"

    def run(self, jaxpr: Any, consts: Sequence[Any], arguments: list[Any]) -> list[Any]:
        """The outputs of a jaxpr."""
        values: dict[Any, Any] = {}

        def read(atom: Any) -> Any:
            return np.asarray(atom.val) if isinstance(atom, core.Literal) else values[atom]

        for variable, const in zip(jaxpr.constvars, consts, strict=True):
            values[variable] = np.asarray(const)
        for variable, argument in zip(jaxpr.invars, arguments, strict=True):
            values[variable] = argument
        needed = _needed(jaxpr)
        for equation in jaxpr.eqns:
            if equation not in needed:
                continue
            inputs = [read(atom) for atom in equation.invars]
            outputs = self._equation(equation, inputs)
            for variable, output in zip(equation.outvars, outputs, strict=True):
                values[variable] = output
        return [read(atom) for atom in jaxpr.outvars]

    def _equation(self, equation: Any, inputs: list[Any]) -> list[Any]:
        primitive, parameters = equation.primitive, equation.params
        name = primitive.name
        # What JAX makes of its own accord names no line: then it is that of what it was made for.
        self.where = source_info_util.summarize(equation.source_info) or self.where
        inner = parameters.get("jaxpr", parameters.get("call_jaxpr", parameters.get("call")))
        if name != "cond" and inner is not None and name not in ("scan", "while"):
            closed = hasattr(inner, "consts")
            return self.run(inner.jaxpr if closed else inner, inner.consts if closed else (), inputs)
        # Keys are no arrays of numbers for JAX: the rules have their words.
        if all(_is_known(value) for value in inputs) and name != "cond" and not name.startswith("random_"):
            with jax.ensure_compile_time_eval():
                found = primitive.bind(*map(jax.numpy.asarray, inputs), **parameters)
            return [np.asarray(one) for one in (found if primitive.multiple_results else [found])]
        rule = getattr(self, f"_{name}", None) or _ELEMENTWISE.get(name)
        try:
            if rule is None:
                raise NotImplementedError("there is no rule for it")
            if name in _ELEMENTWISE:
                return [self._each(_ELEMENTWISE[name], inputs, equation.outvars[0].aval)]
            plain = {key: _whole(value) for key, value in parameters.items()}
            result: Any = rule(equation.replace(params=plain), *inputs)
            return result if primitive.multiple_results else [result]
        except NotImplementedError as error:
            raise NotTranslatable(
                f"cannot translate the primitive {name!r} of {self.where}: {error}"
            ) from None

    # Values

    def nodes(self, value: Any) -> Nodes:
        """A value without loop as an array of nodes."""
        assert not isinstance(value, Looped)
        if not _is_known(value):
            return value
        made = np.empty(value.shape, object)
        for place in np.ndindex(value.shape):
            made[place] = self.program.constant(value[place])
        return made

    def looped(self, value: Any, axis: int) -> Looped:
        """A value with its dimension `axis` as a loop."""
        if isinstance(value, Looped):
            if value.axis != axis:
                raise NotImplementedError("two long dimensions at once")
            return value
        size, counter = value.shape[axis], self.program.counter(value.shape[axis])
        moved = np.moveaxis(value, axis, 0)
        nodes = np.empty(moved.shape[1:], object)
        for place in np.ndindex(nodes.shape):
            column = moved[(slice(None), *place)]
            if _is_known(value):
                same = bool(np.all(column == column[0]))
                nodes[place] = (
                    self.program.constant(column[0])
                    if same
                    else self.program.entry(np.ascontiguousarray(column), counter)
                )
            elif all(node is column[0] for node in column):
                nodes[place] = column[0]
            else:
                array = self.program.store(list(enumerate(column)), column[0].kind, size)
                nodes[place] = self.program.element(array, counter)
        return Looped(nodes, axis, size)

    def written_out(self, value: Any) -> Nodes:
        """A value as nodes outside of loops."""
        if not isinstance(value, Looped):
            return self.nodes(value)
        made = np.empty((value.size, *value.nodes.shape), object)
        for place in np.ndindex(value.nodes.shape):
            array = self._array(value.nodes[place], value.size)
            for i in range(value.size):
                made[(i, *place)] = self.program.element(array, self.program.constant(np.int32(i)))
        return np.moveaxis(made, 0, value.axis)

    def _array(self, node: Node, size: int) -> Stored:
        """An array of the values that a node has in its loop."""
        if node.size is None:
            return self.program.store([(i, node) for i in range(size)], node.kind, size)
        return self.program.store([(0, node)], node.kind, size)

    def op(self, operation: str, *inputs: Node) -> Node:
        """The node of an elementwise operation; computed now where everything is known."""
        flag = operation in _FLAGS and (operation, inputs[0].kind) != ("not", "i")
        kind = "b" if flag else inputs[operation == "select"].kind
        if all(node.constant for node in inputs) and operation in _NOW:
            with np.errstate(all="ignore"):
                return self.program.constant(KINDS[kind](_NOW[operation](*(node.about for node in inputs))))
        if operation == "select":
            if inputs[0].constant:
                return inputs[1] if bool(inputs[0].about) else inputs[2]
            if inputs[1] is inputs[2]:
                return inputs[1]
        if operation in ("and", "or") and kind == "b":
            for one, other in (inputs, inputs[::-1]):
                if one.constant:
                    return other if bool(one.about) == (operation == "and") else one
            if inputs[0] is inputs[1]:
                return inputs[0]
        return self.program.make(operation, *inputs, kind=kind)

    def _each(self, rule: Callable[..., Node], inputs: list[Any], aval: Any) -> Any:
        """A rule for single numbers, on all entries."""
        shape = aval.shape
        axis = next((value.axis for value in inputs if isinstance(value, Looped)), None)
        if axis is None:
            axis = next((k for k, size in enumerate(shape) if size >= LONG), None)
        if axis is not None:
            parts = [self.looped(value, axis).nodes if value.shape else self.nodes(value) for value in inputs]
            shape = shape[:axis] + shape[axis + 1 :]
        else:
            parts = [self.nodes(value) for value in inputs]
        parts = [np.broadcast_to(part, shape) for part in parts]
        made = np.empty(shape, object)
        for place in np.ndindex(shape):
            made[place] = rule(self, *(part[place] for part in parts))
        return made if axis is None else Looped(made, axis, aval.shape[axis])

    # Rules for what is not elementwise

    def _broadcast_in_dim(self, equation: Any, value: Any, *_: Any) -> Any:
        shape = equation.params["shape"]
        dimensions = equation.params["broadcast_dimensions"]
        if isinstance(value, Looped):
            axis = dimensions[value.axis]
            kept = [d - (d > axis) for k, d in enumerate(dimensions) if k != value.axis]
            inner = shape[:axis] + shape[axis + 1 :]
            return Looped(_spread(value.nodes, inner, kept), axis, value.size)
        long = [k for k, size in enumerate(shape) if size >= LONG and k not in dimensions]
        nodes = self.nodes(value)
        if not long:
            return _spread(nodes, shape, dimensions)
        axis = long[0]
        kept = [d - (d > axis) for d in dimensions]
        return Looped(_spread(nodes, shape[:axis] + shape[axis + 1 :], kept), axis, shape[axis])

    def _reshape(self, equation: Any, value: Any, *_: Any) -> Any:
        shape = equation.params["new_sizes"]
        if not isinstance(value, Looped):
            return self.nodes(value).reshape(shape)
        before = math.prod(value.shape[: value.axis])
        fitting = [k for k, size in enumerate(shape) if size == value.size and math.prod(shape[:k]) == before]
        if not fitting:
            raise NotImplementedError("it cuts a long dimension")
        axis = fitting[0]
        return Looped(value.nodes.reshape(shape[:axis] + shape[axis + 1 :]), axis, value.size)

    def _squeeze(self, equation: Any, value: Any) -> Any:
        gone = equation.params["dimensions"]
        if not isinstance(value, Looped):
            return np.squeeze(self.nodes(value), gone)
        nodes = np.squeeze(value.nodes, tuple(d - (d > value.axis) for d in gone))
        return Looped(nodes, value.axis - sum(d < value.axis for d in gone), value.size)

    def _transpose(self, equation: Any, value: Any) -> Any:
        order = equation.params["permutation"]
        if not isinstance(value, Looped):
            return np.transpose(self.nodes(value), order)
        inner = [d - (d > value.axis) for d in order if d != value.axis]
        return Looped(np.transpose(value.nodes, inner), order.index(value.axis), value.size)

    def _slice(self, equation: Any, value: Any) -> Any:
        parameters = equation.params
        steps = parameters["strides"] or (1,) * len(parameters["start_indices"])
        cuts = [
            slice(*cut)
            for cut in zip(parameters["start_indices"], parameters["limit_indices"], steps, strict=True)
        ]
        if not isinstance(value, Looped):
            return self.nodes(value)[tuple(cuts)]
        cut = cuts.pop(value.axis)
        kept = value.nodes[(*cuts, ...)]
        if cut == slice(0, value.size, 1):
            return Looped(kept, value.axis, value.size)
        size = len(range(*cut.indices(value.size)))
        counter = self.program.counter(size)

        def part(node: Node) -> Any:
            if node.size is None:
                return [node] * size if size < LONG else node
            array = self._array(node, value.size)
            if size < LONG:
                places = [self.program.constant(np.int32(cut.start + i * cut.step)) for i in range(size)]
                return [self.program.element(array, place) for place in places]
            place = self.op("mul", counter, self.program.constant(np.int32(cut.step)))
            place = self.op("add", place, self.program.constant(np.int32(cut.start)))
            return self.program.element(array, place)

        if size >= LONG:
            nodes = np.empty(kept.shape, object)
            for place in np.ndindex(kept.shape):
                nodes[place] = part(kept[place])
            return Looped(nodes, value.axis, size)
        made = np.empty((size, *kept.shape), object)
        for place in np.ndindex(kept.shape):
            made[(slice(None), *place)] = part(kept[place])
        return np.moveaxis(made, 0, value.axis)

    def _rev(self, equation: Any, value: Any) -> Any:
        if isinstance(value, Looped):
            raise NotImplementedError("a long dimension")
        return np.flip(self.nodes(value), equation.params["dimensions"])

    def _concatenate(self, equation: Any, *values: Any) -> Any:
        return self._joined(values, equation.params["dimension"])

    def _stack(self, equation: Any, *values: Any) -> Any:
        axis = equation.params["axis"]
        shape = list(equation.outvars[0].aval.shape)
        shape[axis] = 1
        return self._joined([self._reshape_to(value, tuple(shape)) for value in values], axis)

    def _reshape_to(self, value: Any, shape: tuple[int, ...]) -> Any:
        """One dimension of size 1 more."""
        if not isinstance(value, Looped):
            return self.nodes(value).reshape(shape)
        sizes = enumerate(shape)
        new = next(k for k, size in sizes if size == 1 and shape[:k] + shape[k + 1 :] == value.shape)
        axis = value.axis + (new <= value.axis)
        return Looped(value.nodes.reshape(shape[:axis] + shape[axis + 1 :]), axis, value.size)

    def _joined(self, values: Sequence[Any], along: int) -> Any:
        total, shape = sum(value.shape[along] for value in values), list(values[0].shape)
        values = [value for value in values if 0 not in value.shape]
        if not values:
            shape[along] = total
            return np.empty(shape, object)
        looped = [value for value in values if isinstance(value, Looped)]
        axis = looped[0].axis if looped else (along if total >= LONG else None)
        if axis is None:
            return np.concatenate([self.nodes(value) for value in values], along)
        if axis != along:
            parts = [self.looped(value, axis).nodes for value in values]
            return Looped(np.concatenate(parts, along - (along > axis)), axis, values[0].shape[axis])
        # Along the loop itself: through an array.
        shape = values[0].shape[:axis] + values[0].shape[axis + 1 :]
        nodes, counter = np.empty(shape, object), self.program.counter(total)
        for place in np.ndindex(shape):
            parts, offset = [], 0
            for value in values:
                if isinstance(value, Looped) and value.nodes[place].size is not None:
                    parts.append((offset, value.nodes[place]))
                elif isinstance(value, Looped):
                    parts += [(offset + i, value.nodes[place]) for i in range(value.size)]
                elif _is_known(value) and value.shape[axis] >= LONG:
                    parts.append((offset, self.looped(value, axis).nodes[place]))
                else:
                    column = np.moveaxis(self.nodes(value), axis, 0)[(slice(None), *place)]
                    parts += [(offset + i, node) for i, node in enumerate(column)]
                offset += value.shape[axis]
            array = self.program.store(parts, parts[0][1].kind, total)
            nodes[place] = self.program.element(array, counter)
        return Looped(nodes, axis, total)

    def _cumprod(self, equation: Any, value: Any) -> Any:
        return self._running("mul", equation, value)

    def _cumsum(self, equation: Any, value: Any) -> Any:
        return self._running("add", equation, value)

    def _cummax(self, equation: Any, value: Any) -> Any:
        return self._running("max", equation, value)

    def _running(self, operation: str, equation: Any, value: Any) -> Any:
        axis = equation.params["axis"]
        if isinstance(value, Looped) or equation.params["reverse"]:
            raise NotImplementedError("backwards, or along a long dimension")
        rows = np.moveaxis(self.nodes(value), axis, 0).copy()
        for k in range(1, len(rows)):
            for place in np.ndindex(rows.shape[1:]):
                rows[(k, *place)] = self.op(operation, rows[(k - 1, *place)], rows[(k, *place)])
        return np.moveaxis(rows, 0, axis)

    def _reduced(self, operation: str, value: Any, axes: Sequence[int]) -> Any:
        """`operation` over some dimensions, the loop's own last."""
        loop = value.axis if isinstance(value, Looped) else len(value.shape)
        rolled = loop in axes
        nodes = value.nodes if isinstance(value, Looped) else self.nodes(value)
        inner = tuple(sorted(d - (d > loop) for d in axes if d != loop))
        rest = [k for k in range(nodes.ndim) if k not in inner]
        count = math.prod(nodes.shape[k] for k in inner)
        moved = np.transpose(nodes, (*rest, *inner)).reshape(*(nodes.shape[k] for k in rest), count)
        made = np.empty(moved.shape[:-1], object)
        for place in np.ndindex(made.shape):
            entries = list(moved[place])
            found = entries[0] if entries else self.program.constant(_NEUTRAL[operation])
            for one in entries[1:]:
                found = self.op(operation, found, one)
            if rolled:
                found = self._over_loop(operation, found, value.size)
            made[place] = found
        if isinstance(value, Looped) and not rolled:
            return Looped(made, value.axis - sum(d < value.axis for d in axes), value.size)
        return made

    def _over_loop(self, operation: str, node: Node, size: int) -> Node:
        if node.size is not None:
            return self.program.reduce(operation, node)
        if operation == "add":
            return self.op("mul", node, self.program.constant(KINDS[node.kind](size)))
        return node

    def _reduce_min(self, equation: Any, value: Any) -> Any:
        return self._reduced("min", value, equation.params["axes"])

    def _reduce_max(self, equation: Any, value: Any) -> Any:
        return self._reduced("max", value, equation.params["axes"])

    def _reduce_sum(self, equation: Any, value: Any) -> Any:
        return self._reduced("add", value, equation.params["axes"])

    def _reduce_and(self, equation: Any, value: Any) -> Any:
        return self._reduced("and", value, equation.params["axes"])

    def _reduce_or(self, equation: Any, value: Any) -> Any:
        return self._reduced("or", value, equation.params["axes"])

    def _argmin(self, equation: Any, value: Any) -> Any:
        return self._place_of("lt", "argmin", equation, value)

    def _argmax(self, equation: Any, value: Any) -> Any:
        return self._place_of("gt", "argmax", equation, value)

    def _place_of(self, better: str, operation: str, equation: Any, value: Any) -> Any:
        """The first place of the least or largest entry; that of a NaN where there is one."""
        (axis,) = equation.params["axes"]
        if isinstance(value, Looped):
            if value.axis != axis:
                raise NotImplementedError("inside a long dimension")
            made = np.empty(value.nodes.shape, object)
            for place in np.ndindex(made.shape):
                node = value.nodes[place]
                first = self.program.constant(np.int32(0))
                made[place] = first if node.size is None else self.program.reduce(operation, node)
            return made
        rows = np.moveaxis(self.nodes(value), axis, 0)
        made = np.empty(rows.shape[1:], object)
        for place in np.ndindex(made.shape):
            best, index = rows[(0, *place)], self.program.constant(np.int32(0))
            for k in range(1, len(rows)):
                one = rows[(k, *place)]
                wins = self.op("or", self.op(better, one, best), self.op("ne", one, one))
                wins = self.op("and", wins, self.op("eq", best, best))
                index = self.op("select", wins, self.program.constant(np.int32(k)), index)
                best = self.op("select", wins, one, best)
            made[place] = index
        return made

    def _sort(self, equation: Any, *values: Any) -> list[Any]:
        """By the first value; NaN last, equal ones as they were."""
        axis = equation.params["dimension"]
        if any(isinstance(value, Looped) for value in values) or equation.params["num_keys"] != 1:
            raise NotImplementedError("a long dimension, or several keys")
        rows = [np.moveaxis(self.nodes(value), axis, 0) for value in values]
        made = [np.empty_like(row) for row in rows]
        count = len(rows[0])
        for place in np.ndindex(rows[0].shape[1:]):
            keys = [rows[0][(k, *place)] for k in range(count)]
            ranks = []
            for k, key in enumerate(keys):
                rank = self.program.constant(np.int32(0))
                for j, other in enumerate(keys):
                    if j != k:
                        ahead = (
                            self._not_after(other, key)
                            if j < k
                            else self.op("not", self._not_after(key, other))
                        )
                        step = self.op("select", ahead, *(self.program.constant(np.int32(n)) for n in (1, 0)))
                        rank = self.op("add", rank, step)
                ranks.append(rank)
            for row, out in zip(rows, made, strict=True):
                for to in range(count):
                    found = row[(0, *place)]
                    for k in range(1, count):
                        here = self.op("eq", ranks[k], self.program.constant(np.int32(to)))
                        found = self.op("select", here, row[(k, *place)], found)
                    out[(to, *place)] = found
        return [np.moveaxis(out, 0, axis) for out in made]

    def _not_after(self, one: Node, other: Node) -> Node:
        """Whether one number is at most the other, where a NaN is larger than all."""
        at_most = self.op("le", one, other)
        return at_most if one.kind != "f" else self.op("or", at_most, self.op("ne", other, other))

    # Looking things up

    def _dynamic_slice(self, equation: Any, value: Any, *starts: Any) -> Any:
        sizes = equation.params["slice_sizes"]
        if any(isinstance(start, Looped) for start in starts):
            raise NotImplementedError("a start that changes in a loop")
        indices = [self.nodes(start)[()] for start in starts]
        made = np.empty(sizes, object)
        firsts = [
            self._clipped(index, size - length)
            for index, size, length in zip(indices, value.shape, sizes, strict=True)
        ]
        for place in np.ndindex(*sizes):
            at = [
                self.op("add", first, self.program.constant(np.int32(step))) if step else first
                for first, step in zip(firsts, place, strict=True)
            ]
            made[place] = self._look_up(value, at)
        return made

    def _gather(self, equation: Any, value: Any, indices: Any) -> Any:
        parameters = equation.params
        numbers, sizes = parameters["dimension_numbers"], parameters["slice_sizes"]
        if numbers.operand_batching_dims:
            raise NotImplementedError("batching dimensions")
        fills, fill = "FILL" in str(parameters["mode"]), parameters["fill_value"]
        if fills and np.dtype(equation.outvars[0].aval.dtype).kind != "f" and fill is None:
            raise NotImplementedError("a mode that fills in whole numbers")
        filled = self.program.constant(np.float32(np.nan) if fill is None else np.asarray(fill))
        shape = equation.outvars[0].aval.shape
        batch = [k for k in range(len(shape)) if k not in numbers.offset_dims]
        kept = [d for d in range(len(sizes)) if d not in numbers.collapsed_slice_dims]
        loop = isinstance(indices, Looped)
        if loop and indices.axis == len(indices.shape) - 1:
            raise NotImplementedError("a loop over coordinates")
        axis = batch[indices.axis] if loop else None
        nodes = indices.nodes if loop else self.nodes(indices)
        if loop:
            batch = [k for k in batch if k != axis]
        made_shape = tuple(size for k, size in enumerate(shape) if k != axis)
        made = np.empty(made_shape, object)
        for place in np.ndindex(*made_shape):
            whole = list(place)
            if axis is not None:
                whole.insert(axis, 0)
            start = nodes[tuple(whole[k] for k in batch)]
            at = [self.program.constant(np.int32(0))] * len(sizes)
            inside = self.program.constant(True)
            for k, d in enumerate(numbers.start_index_map):
                at[d] = self._clipped(start[k], value.shape[d] - sizes[d])
                inside = self.op("and", inside, self.op("eq", at[d], start[k]))
            for k, d in zip(numbers.offset_dims, kept, strict=True):
                if whole[k]:
                    at[d] = self.op("add", at[d], self.program.constant(np.int32(whole[k])))
            found = self._look_up(value, at)
            made[place] = self.op("select", inside, found, filled) if fills else found
        return made if axis is None else Looped(made, axis, shape[axis])

    def _clipped(self, index: Node, most: int) -> Node:
        zero, last = self.program.constant(np.int32(0)), self.program.constant(np.int32(most))
        return zero if most == 0 else self.op("min", self.op("max", index, zero), last)

    def _look_up(self, value: Any, at: list[Node]) -> Node:
        """The entry at indices that lie within the value."""
        if isinstance(value, Looped):
            inner = [node for k, node in enumerate(at) if k != value.axis]
            if not all(node.constant for node in inner):
                raise NotImplementedError("two indices that are not known")
            node = value.nodes[tuple(int(one.about) for one in inner)]
            if node.size is None:
                return node
            return self.program.element(self._array(node, value.size), at[value.axis])
        flat = self.program.constant(np.int32(0))
        for node, size in zip(at, value.shape, strict=True):
            flat = self.op("mul", flat, self.program.constant(np.int32(size)))
            flat = self.op("add", flat, node)
        if _is_known(value):
            return self.program.entry(value, flat)
        if flat.constant:
            return value.reshape(-1)[int(flat.about)]
        entries = list(value.reshape(-1))
        array = self.program.store(list(enumerate(entries)), entries[0].kind, len(entries))
        return self.program.element(array, flat)

    def _dot_general(self, equation: Any, left: Any, right: Any) -> Any:
        (first, second), (left_batch, right_batch) = equation.params["dimension_numbers"]
        if left_batch or right_batch or len(first) != 1:
            raise NotImplementedError("batches")
        if _is_known(right):
            return self._product(left, first[0], right, second[0])
        if not _is_known(left):
            raise NotImplementedError("both factors are not known")
        return self._product(right, second[0], left, first[0])

    def _product(self, value: Any, axis: int, weights: np.ndarray, along: int) -> Any:
        """Sums over `axis` of a value, a vector, times known `weights` over `along`."""
        n = value.shape[axis]
        if math.prod(value.shape) != n or weights.ndim > 2:
            raise NotImplementedError("products other than of a vector and known weights")
        matrix = np.moveaxis(weights, along, 0).reshape(n, -1).astype(np.float32)
        columns = matrix.shape[1]
        # The vector may have further dimensions, of one entry.
        shape = (1,) * (len(value.shape) - 1) + tuple(np.delete(weights.shape, along))
        if isinstance(value, Looped):
            array = self._array(value.nodes.reshape(-1)[0], n)
        elif max(n, columns) >= LONG:
            array = self.program.store(list(enumerate(self.nodes(value).reshape(-1))), "f", n)
        else:
            array = None
        if columns >= LONG:
            column: Any = [self.program.counter(columns)]
        else:
            column = [self.program.constant(np.int32(k)) for k in range(columns)]
        sums = []
        for j in column:
            if array is not None:
                # A row of weights at a time.
                sums.append(self.program.dot(array, np.ascontiguousarray(matrix.T), j))
                continue
            found = None
            for k, node in enumerate(self.nodes(value).reshape(-1)):
                weight = self.program.entry(np.ascontiguousarray(matrix[k]), j)
                term = self.op("mul", node, weight)
                found = term if found is None else self.op("add", found, term)
            sums.append(found)
        if columns >= LONG:
            made = np.empty(shape[:-1], object)
            made.fill(sums[0])
            return Looped(made, len(shape) - 1, columns)
        result = np.empty(columns, object)
        result[:] = sums
        return result.reshape(shape)

    # Control

    def _cond(self, equation: Any, index: Any, *operands: Any) -> list[Any]:
        branches = equation.params["branches"]

        def follow(branch: Any) -> Callable[[], list[Node]]:
            def nodes() -> list[Node]:
                values = self.run(branch.jaxpr, branch.consts, list(operands))
                return [node for value in values for node in self.written_out(value).reshape(-1)]

            return nodes

        found = self.program.condition(self.nodes(index)[()], [follow(branch) for branch in branches])
        results, used = [], 0
        for variable in equation.outvars:
            size = math.prod(variable.aval.shape)
            made = np.empty(size, object)
            made[:] = found[used : used + size]
            results.append(made.reshape(variable.aval.shape))
            used += size
        return results

    def _scan(self, equation: Any, *values: Any) -> list[Any]:
        """One step after the other, written out: a loop of numbers would need all of its values in arrays."""
        parameters = equation.params
        fixed, length = parameters["num_consts"], parameters["length"]
        if length > _MOST_STEPS:
            raise NotImplementedError(f"{length} steps, one after another")
        if len(values) > fixed + parameters["num_carry"] or len(equation.outvars) > parameters["num_carry"]:
            raise NotImplementedError("arrays that it reads or writes step by step")
        step, carried = parameters["jaxpr"], list(values[fixed:])
        for _ in range(length):
            carried = self.run(step.jaxpr, step.consts, [*values[:fixed], *carried])
        return carried

    def _optimization_barrier(self, equation: Any, *values: Any) -> list[Any]:
        return list(values)

    def _select_n(self, equation: Any, which: Any, *cases: Any) -> Any:
        if len(cases) != 2:
            raise NotImplementedError("more than two cases")
        return self._each(
            lambda me, flag, no, yes: me.op("select", _flag(me, flag), yes, no),
            [which, *cases],
            equation.outvars[0].aval,
        )

    def _convert_element_type(self, equation: Any, value: Any) -> Any:
        kind = kind_of(equation.params["new_dtype"])

        def convert(me: _Translator, node: Node) -> Node:
            if node.kind == kind:
                return node
            if node.constant:
                return me.program.constant(KINDS[kind](node.about))
            return me.program.make(f"to_{kind}", node, kind=kind)

        return self._each(convert, [value], equation.outvars[0].aval)

    def _round(self, equation: Any, value: Any) -> Any:
        if equation.params["rounding_method"] != jax.lax.RoundingMethod.TO_NEAREST_EVEN:
            raise NotImplementedError("rounding away from zero")
        return self._each(_plain("round"), [value], equation.outvars[0].aval)

    def _integer_pow(self, equation: Any, value: Any) -> Any:
        power = equation.params["y"]
        if power < 1:
            raise NotImplementedError(f"power {power}")

        def raised(me: _Translator, node: Node) -> Node:
            found = node
            for _ in range(power - 1):
                found = me.op("mul", found, node)
            return found

        return self._each(raised, [value], equation.outvars[0].aval)


def _flag(me: _Translator, node: Node) -> Node:
    return node if node.kind == "b" else me.op("ne", node, me.program.constant(np.int32(0)))


def _spread(nodes: Nodes, shape: tuple[int, ...], dimensions: Sequence[int]) -> Nodes:
    """`lax.broadcast_in_dim` of an array of nodes."""
    own = [1] * len(shape)
    for k, d in enumerate(dimensions):
        own[d] = nodes.shape[k]
    return np.broadcast_to(nodes.reshape(own), shape)


def _whole(value: Any) -> Any:
    """A parameter with NumPy's whole numbers as Python's: `vmap` writes them."""
    if isinstance(value, tuple) and type(value) is tuple:
        return tuple(map(_whole, value))
    return int(value) if isinstance(value, np.integer) else value


def _needed(jaxpr: Any) -> set[Any]:
    """The equations on which the outputs depend."""
    wanted = {atom for atom in jaxpr.outvars if not isinstance(atom, core.Literal)}
    found = set()
    for equation in reversed(jaxpr.eqns):
        if any(variable in wanted for variable in equation.outvars):
            found.add(equation)
            wanted |= {atom for atom in equation.invars if not isinstance(atom, core.Literal)}
    return found


def _plain(operation: str) -> Callable[..., Node]:
    return lambda me, *inputs: me.op(operation, *inputs)


_FLAGS = ("eq", "ne", "lt", "le", "gt", "ge", "is_finite", "not")
_NEUTRAL: dict[str, Any] = {
    "min": np.float32(np.inf), "max": np.float32(-np.inf), "add": np.float32(0.0), "and": True, "or": False,
}  # fmt: skip
_NOW: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "min": np.minimum, "max": np.maximum,
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert,
    "neg": np.negative, "abs": np.abs, "is_finite": np.isfinite,
}  # fmt: skip
"""What is computed at once where all inputs are known: it gives the same bits everywhere."""
_ELEMENTWISE: dict[str, Callable[..., Node]] = {
    name: _plain(name)
    for name in (
        "add", "sub", "mul", "div", "rem", "max", "min", "pow", "atan2", "and", "or", "xor",
        "eq", "ne", "lt", "le", "gt", "ge", "not", "neg", "abs", "sqrt", "cos", "sin", "tan", "acos", "asin",
        "atan", "exp", "log", "log1p", "expm1", "asinh", "tanh", "floor", "ceil", "sign", "is_finite",
    )
} | {
    "rsqrt": lambda me, x: me.op("div", me.program.constant(np.float32(1.0)), me.op("sqrt", x)),
    "square": lambda me, x: me.op("mul", x, x),
    "stop_gradient": lambda me, x: x,
    "copy": lambda me, x: x,
    "copy_p": lambda me, x: x,
    "clamp": lambda me, low, x, high: me.op("min", me.op("max", x, low), high),
}  # fmt: skip
