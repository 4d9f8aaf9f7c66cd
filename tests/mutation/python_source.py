"""Python: where a source can be mutated. Parsed by ast, whose positions are exact."""

import ast
import io
import tokenize
from collections.abc import Iterator
from itertools import pairwise
from typing import Final

from tests.mutation.mutation import Mutation, Place, mutations

OPERATORS: Final[dict[type[ast.AST], tuple[str, tuple[str, ...]]]] = {
    ast.Add: ("+", ("-",)),
    ast.Sub: ("-", ("+",)),
    ast.Mult: ("*", ("/",)),
    ast.Div: ("/", ("*",)),
    ast.FloorDiv: ("//", ("*",)),
    ast.Mod: ("%", ("*",)),
    ast.Pow: ("**", ("*",)),
    ast.LShift: ("<<", (">>",)),
    ast.RShift: (">>", ("<<",)),
    ast.BitAnd: ("&", ("|",)),
    ast.BitOr: ("|", ("&",)),
    ast.BitXor: ("^", ("&",)),
    ast.Lt: ("<", ("<=", ">=")),
    ast.LtE: ("<=", ("<", ">")),
    ast.Gt: (">", (">=", "<=")),
    ast.GtE: (">=", (">", "<")),
    ast.Eq: ("==", ("!=",)),
    ast.NotEq: ("!=", ("==",)),
    ast.Is: ("is", ("is not",)),
    ast.IsNot: ("is not", ("is",)),
    ast.In: ("in", ("not in",)),
    ast.NotIn: ("not in", ("in",)),
    ast.And: ("and", ("or",)),
    ast.Or: ("or", ("and",)),
}


class _Source:
    """Bytes of a file with what is needed to find a node's place in them."""

    def __init__(self, source: bytes) -> None:
        self.source = source
        self.tree = ast.parse(source)
        self._line_starts = [0]
        for line in source.splitlines(keepends=True):
            self._line_starts.append(self._line_starts[-1] + len(line))
        self._tokens = list(self._code_tokens())
        self.skipped = set(self._not_code())
        self.empty_ends = set(self._empty_ends())

    def _code_tokens(self) -> Iterator[tuple[int, int, str]]:
        text = self.source.decode().splitlines(keepends=True)
        for token in tokenize.generate_tokens(io.StringIO(self.source.decode()).readline):
            if token.type in {tokenize.OP, tokenize.NAME}:
                row, column = token.start
                start = self._line_starts[row - 1] + len(text[row - 1][:column].encode())
                yield start, start + len(token.string.encode()), token.string

    def span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start = self._line_starts[node.lineno - 1] + node.col_offset
        return start, self._line_starts[node.end_lineno - 1] + node.end_col_offset

    def text(self, node: ast.expr | ast.stmt) -> str:
        start, end = self.span(node)
        return self.source[start:end].decode()

    def operator(self, after: int, before: int, text: str) -> tuple[int, int] | None:
        """Return where the operator TEXT stands between two operands."""
        words = text.split()
        between = [token for token in self._tokens if after <= token[0] < before]
        for at in range(len(between)):
            found = between[at : at + len(words)]
            if [token[2] for token in found] == words:
                return found[0][0], found[-1][1]
        return None

    def _empty_ends(self) -> Iterator[ast.stmt]:
        """Yield returns of nothing at the end of a function, which would return nothing without them."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                last = node.body[-1]
                if isinstance(last, ast.Return) and (
                    last.value is None or (isinstance(last.value, ast.Constant) and last.value.value is None)
                ):
                    yield last

    def _not_code(self) -> Iterator[ast.AST]:
        """Yield annotations, decorators' flags and what only a type checker executes."""
        for node in ast.walk(self.tree):
            roots: list[ast.AST | None] = []
            if isinstance(node, ast.AnnAssign | ast.arg):
                roots.append(node.annotation)
            elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                roots += [node.returns, *node.decorator_list]
            elif isinstance(node, ast.ClassDef):
                roots += node.decorator_list
            elif (
                isinstance(node, ast.If)
                and isinstance(node.test, ast.Name)
                and node.test.id == "TYPE_CHECKING"
            ):
                roots.append(node)
            elif isinstance(node, ast.Raise):
                # What an error's sentence says is not mutated; whether it is raised is.
                roots += [node.exc, node.cause]
            for root in roots:
                if root is not None:
                    yield from ast.walk(root)


def find_mutations(file: str, source: bytes) -> list[Mutation]:
    """Return all mutations of the Python file FILE that reads SOURCE."""
    parsed = _Source(source)
    places: list[Place] = []
    for node in ast.walk(parsed.tree):
        if node not in parsed.skipped or isinstance(node, ast.Raise):
            places += _operators(parsed, node)
            places += _literals(parsed, node)
            places += _conditions(parsed, node)
            places += _deletions(parsed, node)
    return mutations(file, source, places)


def statement_line(source: bytes, position: int) -> int:
    """Return the first line of the innermost statement of SOURCE that contains the byte at POSITION."""
    parsed = _Source(source)
    spans = [
        (*parsed.span(node), node.lineno) for node in ast.walk(parsed.tree) if isinstance(node, ast.stmt)
    ]
    return min((end - start, line) for start, end, line in spans if start <= position < end)[1]


def _operators(parsed: _Source, node: ast.AST) -> Iterator[Place]:
    operator: ast.AST
    operands: list[tuple[ast.AST, int, int]] = []
    if isinstance(node, ast.BinOp):
        operands = [(node.op, parsed.span(node.left)[1], parsed.span(node.right)[0])]
    elif isinstance(node, ast.BoolOp):
        for left, right in pairwise(node.values):
            operands.append((node.op, parsed.span(left)[1], parsed.span(right)[0]))
    elif isinstance(node, ast.Compare):
        for operator, left, right in zip(
            node.ops, [node.left, *node.comparators], node.comparators, strict=False
        ):
            operands.append((operator, parsed.span(left)[1], parsed.span(right)[0]))
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub | ast.Invert):
        text = {ast.Not: "not", ast.USub: "-", ast.Invert: "~"}[type(node.op)]
        if found := parsed.operator(parsed.span(node)[0], parsed.span(node.operand)[0], text):
            yield Place(*found, ("",))
    elif isinstance(node, ast.AugAssign):
        text, replacements = OPERATORS[type(node.op)]
        found = parsed.operator(parsed.span(node.target)[1], parsed.span(node.value)[0], text + "=")
        if found:
            yield Place(*found, tuple(f"{replacement}=" for replacement in replacements))
    for operator, after, before in operands:
        if type(operator) in OPERATORS:
            text, replacements = OPERATORS[type(operator)]
            if place := parsed.operator(after, before, text):
                yield Place(*place, replacements)


def _literals(parsed: _Source, node: ast.AST) -> Iterator[Place]:
    if not isinstance(node, ast.Constant):
        return
    span = parsed.span(node)
    if isinstance(node.value, bool):
        yield Place(*span, (str(not node.value),))
    elif isinstance(node.value, int | float):
        yield Place(*span, (repr(0 if node.value == 1 else node.value + 1),))


def _conditions(parsed: _Source, node: ast.AST) -> Iterator[Place]:
    tests: list[ast.expr] = []
    if isinstance(node, ast.If | ast.While | ast.IfExp):
        tests = [node.test]
    elif isinstance(node, ast.comprehension):
        tests = node.ifs
    for test in tests:
        is_comparison = isinstance(test, ast.Compare) and len(test.ops) == 1
        if not is_comparison and not isinstance(test, ast.NamedExpr):
            yield Place(*parsed.span(test), (f"(not ({parsed.text(test)}))",))


def _deletions(parsed: _Source, node: ast.AST) -> Iterator[Place]:
    if not isinstance(node, ast.stmt):
        return
    is_attribute = isinstance(node, ast.Assign) and all(isinstance(t, ast.Attribute) for t in node.targets)
    # A string is a docstring; "..." is a body that is empty.
    is_call = isinstance(node, ast.Expr) and not isinstance(node.value, ast.Constant)
    deletable = isinstance(
        node, ast.AugAssign | ast.Raise | ast.Break | ast.Continue | ast.Return | ast.Delete
    )
    if (is_attribute or is_call or deletable) and node not in parsed.empty_ends:
        yield Place(*parsed.span(node), ("pass",))
