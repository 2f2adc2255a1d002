"""Which numbers share a node of a graph.

A pack is a tuple of numbers that one operation computes side by side. It saves nodes where what the numbers
are computed from stands side by side, too; otherwise that has to be put together first. Compilers know this
as superword-level parallelism (S. Larsen and S. Amarasinghe, 2000): a pack grows from a seed, numbers that
are computed alike, towards what they are computed from. Here it stays if the whole graph becomes cheaper.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, no_type_check

from sidestep.bridges.export.numbers import Numbers
from sidestep.bridges.export.program import Node

Pack: TypeAlias = tuple[Node, ...]
"""Numbers that one node of a graph computes."""
_ALONE = ("given", "counter", "same", "dot", "reduce", "element")
_DEPTHS = (4, 2, 1)
"""How far back two numbers are computed alike: the most similar ones are tried first."""
_FEW = 1500
"""Numbers up to which every seed is tried by itself."""


def find_packs(numbers: Numbers, cost: Callable[[Sequence[Pack]], float]) -> list[Pack]:
    """Packs that make a graph cheap; `cost` is that of the graph with some packs, infinite where they need
    each other. It may change the order of the inputs of a sum or product."""
    return _Search(numbers, cost).run()


@no_type_check  # called millions of times: checking types would take the tests a minute
class _Search:
    def __init__(self, numbers: Numbers, cost: Callable[[Sequence[Pack]], float]):
        self.numbers, self.cost_of = numbers, cost
        self.packs: list[Pack] = []
        self.packed: set[Node] = set()
        self.tried: set[frozenset[Pack]] = set()
        self.cost = cost([])
        self.level: dict[Node, int] = {}
        for node in numbers.order:
            self.level[node] = 1 + max((self.level.get(one, 0) for one in numbers.needs(node)), default=0)
        self.shapes = self._shapes()

    def _shapes(self) -> list[dict[Node, int]]:
        """By depth, a number that is the same for nodes that are computed alike so far back."""
        found: list[dict[Node, int]] = []
        seen: dict[Any, int] = {}
        for depth in range(_DEPTHS[0] + 1):
            shapes: dict[Node, int] = {}
            for node in self.numbers.order:
                key: Any = self._form(node)
                if depth:
                    inputs = [
                        found[-1][one] if one in found[-1] else seen.setdefault(self._form(one), len(seen))
                        for one in self.numbers.inputs[node]
                    ]
                    key = (key, *(sorted(inputs) if self.numbers.commutes(node) else inputs))
                shapes[node] = seen.setdefault((depth, key), len(seen))
            found.append(shapes)
        return found

    def _form(self, node: Node) -> tuple[Any, ...]:
        """What two nodes of a pack have in common."""
        if node not in self.numbers.inputs:
            return node.operation, node.kind
        inputs = self.numbers.inputs[node]
        return self.numbers.operations[node], node.kind, node.about, tuple(one.kind for one in inputs)

    def run(self) -> list[Pack]:
        """The packs."""
        for depth in _DEPTHS:
            alike: dict[tuple[int, int], list[Node]] = defaultdict(list)
            for node in self.numbers.order:
                if self._free(node):
                    alike[self.level[node], self.shapes[depth][node]].append(node)
            seeds = [nodes for _, nodes in sorted(alike.items(), reverse=True) if len(nodes) > 1]
            if len(self.numbers.order) > _FEW:
                self._attempt(seeds)
                continue
            for seed in seeds:
                self._attempt([seed])
        return self.packs

    def _free(self, node: Node) -> bool:
        return (
            node in self.numbers.inputs
            and node.size is None
            and node not in self.packed
            and self.numbers.operations[node] not in _ALONE
        )

    def _attempt(self, seeds: list[list[Node]]) -> None:
        """Packs from all of these seeds, else from each half of them."""
        packed, made = set(self.packed), []
        for seed in seeds:
            self._grow([node for node in seed if node not in packed], packed, made)
        if not made or frozenset(made) in self.tried:
            return
        self.tried.add(frozenset(made))
        cost = self.cost_of([*self.packs, *made])
        if cost < self.cost:
            self.packs, self.packed, self.cost = [*self.packs, *made], packed, cost
        elif len(seeds) > 1:
            middle = len(seeds) // 2
            self._attempt(seeds[:middle])
            self._attempt(seeds[middle:])

    def _grow(self, nodes: Sequence[Node], packed: set[Node], made: list[Pack]) -> None:
        """A pack of these nodes, and of what they are computed from, as far as it is alike."""
        nodes = tuple(dict.fromkeys(nodes))
        if len(nodes) < 2 or any(node in packed or not self._free(node) for node in nodes):
            return
        if len({self._form(node) for node in nodes}) > 1:
            return
        made.append(nodes)
        packed.update(nodes)
        if self.numbers.commutes(nodes[0]):
            for node in nodes[1:]:
                self._align(node, self.numbers.inputs[nodes[0]])
        for inputs in zip(*(self.numbers.inputs[node] for node in nodes), strict=True):
            self._grow(inputs, packed, made)

    def _align(self, node: Node, wanted: tuple[Node, ...]) -> None:
        """Swap the inputs of a sum or product if that makes them more like the `wanted` ones."""

        def likeness(inputs: tuple[Node, ...]) -> int:
            return sum(
                (one is other) + (self._shape(one) == self._shape(other))
                for one, other in zip(inputs, wanted, strict=True)
            )

        inputs = self.numbers.inputs[node]
        if likeness(inputs[::-1]) > likeness(inputs):
            self.numbers.inputs[node] = inputs[::-1]

    def _shape(self, node: Node) -> Any:
        return self.shapes[2].get(node, self._form(node))
