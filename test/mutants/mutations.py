"""Mutations of a module: each changes one operator, number, name or statement."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_OPERATORS = {
    ast.Add: '-',
    ast.Sub: '+',
    ast.Mult: '/',
    ast.Div: '*',
    ast.FloorDiv: '/',
    ast.Mod: '*',
    ast.LShift: '>>',
    ast.RShift: '<<',
    ast.BitAnd: '|',
    ast.BitOr: '&',
    ast.Lt: '<=',
    ast.LtE: '<',
    ast.Gt: '>=',
    ast.GtE: '>',
    ast.Eq: '!=',
    ast.NotEq: '==',
    ast.Is: 'is not',
    ast.IsNot: 'is',
    ast.In: 'not in',
    ast.NotIn: 'in',
    ast.And: 'or',
    ast.Or: 'and',
}
_UNARY = {ast.Not: 'not ', ast.USub: '-'}
_NAMES = {
    'min': 'max',
    'max': 'min',
    'any': 'all',
    'all': 'any',
    'minimum': 'maximum',
    'maximum': 'minimum',
    'argmin': 'argmax',
    'argmax': 'argmin',
    'floor': 'ceil',
    'ceil': 'floor',
    'sin': 'cos',
    'cos': 'sin',
}
# Calls whose arguments are texts or types: mutations there change no result.
_SKIPPED = (ast.Raise, ast.Import, ast.ImportFrom, ast.JoinedStr, ast.Assert)
_SKIPPED_CALLS = ('warn', 'cast', 'TypeVar', 'NewType')


@dataclass(frozen=True, order=True)
class Mutation:
    """Text between two offsets of a module, in bytes, and what replaces it."""

    path: Path
    begin: int
    end: int
    text: str

    def applied(self, source: bytes) -> bytes:
        """The module with the mutation."""
        return source[: self.begin] + self.text.encode() + source[self.end :]

    def line(self, source: bytes) -> int:
        """Number of its line, from 1."""
        return source.count(b'\n', 0, self.begin) + 1

    def before_and_after(self, source: bytes) -> tuple[str, str]:
        """Its lines without and with the mutation, each joined into one line."""
        first = source.rfind(b'\n', 0, self.begin) + 1
        last = source.find(b'\n', self.end)
        last = len(source) if last < 0 else last
        after = source[first : self.begin] + self.text.encode() + source[self.end : last]
        return _in_one_line(source[first:last]), _in_one_line(after)


def mutations(path: Path, source: bytes) -> list[Mutation]:
    """All mutations of a module, in the order of its text."""
    return sorted(set(_Finder(path, source).found()))


def _in_one_line(text: bytes) -> str:
    return ' '.join(text.decode().split())


class _Finder:
    """Walks over a module's syntax tree and collects its mutations."""

    def __init__(self, path: Path, source: bytes) -> None:
        self._path = path
        self._source = source
        self._line_starts = [0]
        for line in source.splitlines(keepends=True):
            self._line_starts.append(self._line_starts[-1] + len(line))

    def found(self) -> Iterator[Mutation]:
        yield from self._below(ast.parse(self._source))

    def _below(self, node: ast.AST) -> Iterator[Mutation]:
        if isinstance(node, _SKIPPED) or _is_skipped_call(node):
            return
        yield from self._of(node)
        for child in _children(node):
            yield from self._below(child)

    def _of(self, node: ast.AST) -> Iterator[Mutation]:
        if isinstance(node, ast.BinOp | ast.AugAssign):
            yield from self._of_operator(node)
        elif isinstance(node, ast.Compare):
            operands = [node.left, *node.comparators]
            for k, operator in enumerate(node.ops):
                yield self._between(operands[k], operands[k + 1], _OPERATORS[type(operator)])
        elif isinstance(node, ast.BoolOp):
            for left, right in zip(node.values, node.values[1:], strict=False):
                yield self._between(left, right, _OPERATORS[type(node.op)])
        elif isinstance(node, ast.UnaryOp) and type(node.op) in _UNARY:
            begin = self._begin(node)
            yield self._made(begin, begin + len(_UNARY[type(node.op)]), '')
        elif isinstance(node, ast.Constant):
            yield from self._of_constant(node)
        elif isinstance(node, ast.Call):
            yield from self._of_called_name(node.func)
        elif isinstance(node, ast.Break | ast.Continue):
            other = 'continue' if isinstance(node, ast.Break) else 'break'
            yield self._made(self._begin(node), self._end(node), other)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            yield self._made(self._begin(node), self._end(node), 'pass')

    def _of_operator(self, node: ast.BinOp | ast.AugAssign) -> Iterator[Mutation]:
        if type(node.op) not in _OPERATORS:
            return
        other = _OPERATORS[type(node.op)]
        if isinstance(node, ast.BinOp):
            yield self._between(node.left, node.right, other)
        else:
            yield self._between(node.target, node.value, f'{other}=')

    def _of_constant(self, node: ast.Constant) -> Iterator[Mutation]:
        value = node.value
        if isinstance(value, bool):
            yield self._made(self._begin(node), self._end(node), str(not value))
        elif isinstance(value, int):
            yield self._made(self._begin(node), self._end(node), str(value + 1))
        elif isinstance(value, float):
            yield self._made(self._begin(node), self._end(node), str(2.0 * value or 1.0))

    def _of_called_name(self, function: ast.expr) -> Iterator[Mutation]:
        name = function.attr if isinstance(function, ast.Attribute) else ''
        name = function.id if isinstance(function, ast.Name) else name
        if name in _NAMES:
            end = self._end(function)
            yield self._made(end - len(name), end, _NAMES[name])

    def _between(self, left: ast.expr, right: ast.expr, operator: str) -> Mutation:
        """Another operator between two operands, which may be in brackets."""
        begin = self._end(left)
        end = self._begin(right)
        between = self._source[begin:end]
        brackets = b'() \t\n\\'
        stripped = between.strip(brackets)
        begin += between.index(stripped)
        return self._made(begin, begin + len(stripped), operator)

    def _made(self, begin: int, end: int, text: str) -> Mutation:
        return Mutation(self._path, begin, end, text)

    def _begin(self, node: ast.stmt | ast.expr) -> int:
        return self._line_starts[node.lineno - 1] + node.col_offset

    def _end(self, node: ast.stmt | ast.expr) -> int:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self._line_starts[node.end_lineno - 1] + node.end_col_offset


def _children(node: ast.AST) -> Iterator[ast.AST]:
    """Children that are neither annotations nor decorators."""
    for name, value in ast.iter_fields(node):
        if name in ('annotation', 'returns', 'decorator_list', 'type_params'):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield child


def _is_skipped_call(node: ast.AST) -> bool:
    if isinstance(node, ast.Expr):
        node = node.value
    if not isinstance(node, ast.Call):
        return False
    function = node.func
    name = function.attr if isinstance(function, ast.Attribute) else ''
    return (function.id if isinstance(function, ast.Name) else name) in _SKIPPED_CALLS
