"""What has to be computed for one decision, number by number.

A program is a tree of blocks. A block computes numbers (`Node`s), one after another, and where many of a kind
are needed it has loops over them. Branches of a condition are blocks of their own. Back ends print it.

A block is ordered by *stages*: in each, first its loops run, then the numbers that need their results. So a
loop may only use numbers of earlier stages, and what a later loop needs of an earlier one goes through an
array. Equal numbers are one node, and what depends on constants only is computed here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, no_type_check

import numpy as np

KINDS = {"f": np.float32, "i": np.int32, "b": np.bool_}
"""Kinds of numbers: real ones in single precision, whole ones, and flags."""


def kind_of(dtype: Any) -> str:
    """The kind of numbers of a dtype."""
    return "i" if np.dtype(dtype).kind == "u" else np.dtype(dtype).kind


class NotTranslatable(ValueError):
    """What a function uses and no back end has; names the primitive and the line of ours it comes from."""


class Node:
    """A number. `operation` of `inputs`; `kind` as in `KINDS`; `about` what else the operation needs.

    `size` is that of the loop in which it changes, None outside of loops. `block` and `loop` compute it, from
    `stage` on it is there; constants, the loop's own counter and entries of tables have none.
    """

    __slots__ = ("about", "block", "inputs", "kind", "loop", "operation", "size", "stage")

    def __init__(self, operation: str, inputs: tuple[Node, ...], kind: str, about: Any = None):
        self.operation, self.inputs, self.kind, self.about = operation, inputs, kind, about
        self.size: int | None = None
        self.block: Block | None = None
        self.loop: Loop | None = None
        self.stage = 0

    @property
    def constant(self) -> bool:
        """Whether `about` is its value."""
        return self.operation == "constant"


class Stored:
    """An array that a block fills: `parts` are (offset, node), from loops at the offset plus the counter. It
    is full after `stage`."""

    def __init__(self, kind: str, size: int, block: Block):
        self.kind, self.size, self.block = kind, size, block
        self.parts: list[tuple[int, Node]] = []
        self.stage = 0


class Loop:
    """Numbers computed `size` times in a row; reductions over them are nodes of the block."""

    def __init__(self, size: int, stage: int):
        self.size, self.stage = size, stage
        self.nodes: list[Node] = []


class Block:
    """Nodes in the order in which they were made, and the loops by (stage, size)."""

    def __init__(self, parent: Block | None = None):
        self.parent = parent
        self.nodes: list[Node] = []
        self.loops: dict[tuple[int, int], Loop] = {}
        self.known: dict[Any, Node] = {}
        self.needs = 0
        """The stage of the parent after which all that it takes from there is known."""

    @property
    def stages(self) -> int:
        """How many stages there are."""
        ends = [node.stage for node in self.nodes] + [stage for stage, _ in self.loops]
        return 1 + max(ends, default=0)


class Tables:
    """Constant arrays, each once, by their number; programs may share them."""

    def __init__(self) -> None:
        self.arrays: list[np.ndarray] = []
        self._numbers: dict[Any, int] = {}
        self._seen: dict[int, tuple[np.ndarray, int]] = {}

    def number(self, array: np.ndarray) -> int:
        """The number of an array."""
        if id(array) not in self._seen:
            key = (array.dtype.str, array.tobytes())
            if key not in self._numbers:
                self._numbers[key] = len(self.arrays)
                self.arrays.append(np.ascontiguousarray(array).reshape(-1))
            # The array is kept: its id must not be given to another one.
            self._seen[id(array)] = (array, self._numbers[key])
        return self._seen[id(array)][1]


@no_type_check  # called millions of times: checking types would take the tests a minute
class Program:
    """Builds a program: every method returns the node of what it names, in the block that is open."""

    def __init__(self, tables: Tables | None = None) -> None:
        self.root = self.block = Block()
        self.tables = Tables() if tables is None else tables

    # Leaves

    def constant(self, value: Any) -> Node:
        """A number known now."""
        value = np.asarray(value)
        kind = kind_of(value.dtype)
        number = KINDS[kind](value)
        return self._leaf(("constant", kind, number.tobytes()), Node("constant", (), kind, number))

    def given(self, name: str, kind: str) -> Node:
        """An input, by the name under which the back end finds it."""
        return self._leaf(("given", name), Node("given", (), kind, name))

    def counter(self, size: int) -> Node:
        """The counter of loops of this size, from 0."""
        node = self._leaf(("counter", size), Node("counter", (), "i", size))
        node.size = size
        return node

    def entry(self, table: np.ndarray, index: Node) -> Node:
        """The number at a flat `index` into a constant array, which must lie within it."""
        if index.constant:
            return self.constant(table.reshape(-1)[int(index.about)])
        return self.make("entry", index, kind=kind_of(table.dtype), about=self.tables.number(table))

    def _leaf(self, key: Any, node: Node) -> Node:
        return self.root.known.setdefault(key, node)

    # Operations

    def make(self, operation: str, *inputs: Node, kind: str, about: Any = None) -> Node:
        """The node of an operation, in a loop where an input changes in one."""
        inputs = tuple(self._here(node) for node in inputs)
        sizes = {node.size for node in inputs if node.size is not None}
        if len(sizes) > 1:
            raise NotImplementedError(f"loops of {' and '.join(map(str, sorted(sizes)))} at once")
        node = Node(operation, inputs, kind, about)
        if sizes:
            (node.size,) = sizes
            stage = max([1, *(self._since(one) + (one.size is None) for one in inputs)])
            if isinstance(about, Stored):
                stage = max(stage, self._array_since(about) + 1)
            inputs = node.inputs = tuple(self._at(one, stage) for one in inputs)
            loop = self._loop(node.size, stage)
            key = (operation, _alike(operation, inputs), kind, about, stage)
            if key in self.block.known:
                return self.block.known[key]
            node.block, node.loop, node.stage = self.block, loop, stage
            loop.nodes.append(node)
            self.block.known[key] = node
            return node
        key = (operation, _alike(operation, inputs), kind, about)
        block: Block | None = self.block
        while block is not None:
            if key in block.known:
                return self._here(block.known[key])
            block = block.parent
        node.stage = max([0, *map(self._since, inputs)])
        if isinstance(about, Stored):
            node.stage = max(node.stage, self._array_since(about))
        return self._add(key, node)

    def _add(self, key: Any, node: Node) -> Node:
        node.block = self.block
        self.block.nodes.append(node)
        self.block.known[key] = node
        return node

    def _loop(self, size: int, stage: int) -> Loop:
        return self.block.loops.setdefault((stage, size), Loop(size, stage))

    def reduce(self, operation: str, node: Node) -> Node:
        """`min`, `max`, `add`, `and` or `or` of a node over its loop; `argmin`, `argmax`: the first place."""
        node = self._here(node)
        if node.loop is None:
            # A counter or an entry by itself: it needs a loop to run in.
            node = self.make("same", node, kind=node.kind)
        assert node.loop is not None
        made = Node("reduce", (node,), "i" if operation.startswith("arg") else node.kind, operation)
        made.stage = node.loop.stage
        key = ("reduce", node, operation)
        return self.block.known[key] if key in self.block.known else self._add(key, made)

    # Arrays

    def store(self, parts: list[tuple[int, Node]], kind: str, size: int) -> Stored:
        """An array of the parts: (offset, node)."""
        array = Stored(kind, size, self.block)
        for offset, node in parts:
            here = self._here(node)
            if here.size is not None and here.loop is None:
                here = self.make("same", here, kind=here.kind)
            array.parts.append((offset, here))
            array.stage = max(array.stage, self._since(here))
        statement = Node("store", (), kind, array)
        statement.stage = array.stage
        self._add(("store", array), statement)
        return array

    def dot(self, array: Stored, rows: np.ndarray, row: Node) -> Node:
        """The sum of an array's entries, each times that of one of the `rows (m, n)`."""
        self._note(array.block, array.stage)
        return self.make("dot", row, self.constant(np.int32(self.tables.number(rows))), kind="f", about=array)

    def element(self, array: Stored, index: Node) -> Node:
        """The number at an index of an array, which must lie within it."""
        self._note(array.block, array.stage)
        return self.make("element", index, kind=array.kind, about=array)

    def _spread(self, node: Node) -> Stored:
        """The array of a loop's node."""
        assert node.loop is not None
        assert node.block is not None
        key = ("spread", node)
        if key not in node.block.known:
            array = Stored(node.kind, node.loop.size, node.block)
            array.parts.append((0, node))
            array.stage = node.loop.stage
            node.block.known[key] = array  # type: ignore[assignment]
        return node.block.known[key]  # type: ignore[return-value]

    # Conditions

    def condition(self, index: Node, branches: list[Callable[[], list[Node]]]) -> list[Node]:
        """What the branch with this number returns; only that one is computed."""
        index = self._here(index)
        if index.constant:
            return branches[int(np.clip(index.about, 0, len(branches) - 1))]()
        blocks, results = [], []
        for branch in branches:
            self.block = Block(self.block)
            blocks.append(self.block)
            results.append([self._here(node) for node in branch()])
            assert self.block.parent is not None
            self.block = self.block.parent
        made = Node("condition", (index,), "b", (blocks, results))
        made.stage = max(self._since(index), *(block.needs for block in blocks))
        self._add(("condition", len(self.block.nodes)), made)
        outputs = []
        for k, several in enumerate(zip(*results, strict=True)):
            if all(node is several[0] for node in several) and several[0].block is not blocks[0]:
                outputs.append(several[0])
                continue
            if any(node.size is not None for node in several):
                raise NotImplementedError("a condition that returns a loop")
            outputs.append(self.make("result", made, kind=several[0].kind, about=k))
        return outputs

    # Where things are

    def _since(self, node: Node) -> int:
        """From which stage of the open block on a node is there."""
        return node.stage if node.block is self.block else 0

    def _array_since(self, array: Stored) -> int:
        return array.stage if array.block is self.block else 0

    def _note(self, block: Block | None, stage: int) -> None:
        """The open block takes something from `block` that is there after its `stage`."""
        inner = self.block
        while block is not None and inner is not block:
            assert inner.parent is not None
            if inner.parent is block:
                inner.needs = max(inner.needs, stage)
            inner = inner.parent

    def _here(self, node: Node) -> Node:
        """The node as the open block sees it: one of a loop outside of it through an array."""
        if node.block is None or node.block is self.block:
            return node
        self._note(node.block, node.stage)
        if node.loop is None:
            return node
        return self.make("element", self.counter(node.loop.size), kind=node.kind, about=self._spread(node))

    def _at(self, node: Node, stage: int) -> Node:
        """A loop's node for a loop of a later stage."""
        if node.loop is None or node.loop.stage == stage:
            return node
        if node.operation in ("element", "entry", "same") and node.inputs[0].operation == "counter":
            return self._again(node, stage)
        array = self._spread(node)
        return self._again(Node("element", (self.counter(node.loop.size),), node.kind, array), stage)

    def _again(self, node: Node, stage: int) -> Node:
        key = (node.operation, node.inputs, node.kind, node.about, stage)
        if key not in self.block.known:
            made = Node(node.operation, node.inputs, node.kind, node.about)
            made.size = node.inputs[0].size
            assert made.size is not None
            made.block, made.loop, made.stage = self.block, self._loop(made.size, stage), stage
            made.loop.nodes.append(made)
            self.block.known[key] = made
        return self.block.known[key]


def _alike(operation: str, inputs: tuple[Node, ...]) -> Any:
    """The inputs, in no order where it makes no difference, not even to the sign of a zero."""
    return frozenset(inputs) if operation in ("add", "mul", "and", "or", "eq", "ne") else inputs


def live(program: Program, outputs: list[Node]) -> set[Any]:
    """The nodes, and the arrays, on which the outputs depend."""
    found: set[Any] = set()
    waiting: list[Any] = list(outputs)
    while waiting:
        one = waiting.pop()
        if one in found:
            continue
        found.add(one)
        if isinstance(one, Stored):
            waiting += [node for _, node in one.parts]
            continue
        waiting += one.inputs
        if isinstance(one.about, Stored):
            waiting.append(one.about)
        if one.operation == "result":
            (made,) = one.inputs
            waiting += [results[one.about] for results in made.about[1]]
    return found
