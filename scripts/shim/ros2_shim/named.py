"""Topics, services and actions all have names and types: the verbs that say which."""

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
    """What has a name and types: one of it is a `kind`, and pairs(node) are all that there are."""

    kind: str
    pairs: Callable[[Node], Pairs]
    hides: bool = True
    """Whether names of ROS's own are left out of lists, unless they are asked for."""

    @property
    def list_verb(self) -> Verb:
        """Lists names, and types if asked for."""
        return Verb(f'Names of all {self.kind}s.', self._list_arguments, self._list)

    @property
    def type_verb(self) -> Verb:
        """Says the types of one."""
        return Verb(f'Type of a {self.kind}.', self.name_arguments, self._type)

    def name_arguments(self, parser: ArgumentParser) -> None:
        """Arguments of a verb about one of a `name`."""
        add_graph_arguments(parser)
        parser.add_argument('name', metavar=f'{self.kind}_name')

    def types(self, session: Session, full_name: str) -> list[str]:
        """Types of what has a name; none where nothing has it."""
        return list(dict(self.pairs(session.node)).get(full_name, []))

    def known(self, session: Session, name: str) -> str:
        """Full name of one that is there."""
        full = session.full_name(name, self.kind)
        if not session.found(lambda: self.types(session, full)):
            raise ShimError(f"Unknown {self.kind} '{full}'")
        return full

    def _list_arguments(self, parser: ArgumentParser) -> None:
        add_graph_arguments(parser)
        parser.add_argument('-t', '--show-types', action='store_true', help='types, too')
        count = f'--count-{self.kind}s'
        parser.add_argument('-c', count, action='store_true', dest='count', help='only how many')
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
