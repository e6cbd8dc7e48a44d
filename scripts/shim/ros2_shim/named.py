"""Verbs for the names and types of topics, services and actions."""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import dataclass

from rclpy.node import Node

from ros2_shim.node import is_hidden
from ros2_shim.session import Session
from ros2_shim.verbs import ShimError, Verb, add_graph_arguments, say

Pairs = list[tuple[str, list[str]]]


@dataclass(frozen=True)
class Named:
    """Entities with names and types; kind: their noun; pairs(node): all names with their types."""

    kind: str
    pairs: Callable[[Node], Pairs]
    hides: bool = True
    """Whether lists omit hidden names by default."""

    @property
    def list_verb(self) -> Verb:
        """Verb that lists names, and types on request."""
        return Verb(f'Names of all {self.kind}s.', self._list_arguments, self._list)

    @property
    def type_verb(self) -> Verb:
        """Verb that shows the types of a name."""
        return Verb(f'Type of a {self.kind}.', self.name_arguments, self._type)

    def name_arguments(self, parser: ArgumentParser) -> None:
        """Add the arguments of a verb with a `name`."""
        add_graph_arguments(parser)
        parser.add_argument('name', metavar=f'{self.kind}_name')

    def types(self, session: Session, full_name: str) -> list[str]:
        """Types of a name; empty if it is unknown."""
        return list(dict(self.pairs(session.node)).get(full_name, []))

    def known(self, session: Session, name: str) -> str:
        """Full name of an existing entity; raises ShimError if it is not found."""
        full = session.full_name(name, self.kind)
        if not session.found(lambda: self.types(session, full)):
            raise ShimError(f"Unknown {self.kind} '{full}'")
        return full

    def _list_arguments(self, parser: ArgumentParser) -> None:
        add_graph_arguments(parser)
        parser.add_argument('-t', '--show-types', action='store_true', help='types, too')
        count = f'--count-{self.kind}s'
        parser.add_argument('-c', count, action='store_true', dest='count', help='only the number')
        if self.hides:
            parser.add_argument(
                f'--include-hidden-{self.kind}s',
                action='store_true',
                dest='include_hidden',
                help='hidden ones, too',
            )

    def _list(self, args: Namespace) -> None:
        with Session(args) as session:
            session.settle()
            pairs = self.pairs(session.node)
        if self.hides and not args.include_hidden:
            pairs = [pair for pair in pairs if not is_hidden(pair[0])]
        if args.count:
            say(str(len(pairs)))
            return
        for name, types in pairs:
            say(f'{name} [{", ".join(types)}]' if args.show_types else name)

    def _type(self, args: Namespace) -> None:
        with Session(args) as session:
            for one in self.types(session, self.known(session, args.name)):
                say(one)
