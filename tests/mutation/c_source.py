"""C: where a source can be mutated, and counters in every statement. Parsed by tree-sitter."""

import re
from collections.abc import Iterator
from typing import Final

import tree_sitter_c
from tree_sitter import Language, Node, Parser

from tests.mutation.mutation import Mutation, Place, mutations

_PARSER: Final = Parser(Language(tree_sitter_c.language()))
_INTEGER: Final = re.compile(rb"(0[xX][0-9a-fA-F]+|\d+)([uUlL]*)")
_FLOAT: Final = re.compile(rb"(\d*\.\d*(?:[eE][-+]?\d+)?|\d+[eE][-+]?\d+)([fFlL]?)")

OPERATORS: Final[dict[str, tuple[str, ...]]] = {
    "+": ("-",),
    "-": ("+",),
    "*": ("/",),
    "/": ("*",),
    "%": ("*",),
    "<<": (">>",),
    ">>": ("<<",),
    "&": ("|",),
    "|": ("&",),
    "^": ("&",),
    "<": ("<=", ">="),
    "<=": ("<", ">"),
    ">": (">=", "<="),
    ">=": (">", "<"),
    "==": ("!=",),
    "!=": ("==",),
    "&&": ("||",),
    "||": ("&&",),
    "+=": ("-=",),
    "-=": ("+=",),
    "*=": ("/=",),
    "/=": ("*=",),
    "%=": ("*=",),
    "<<=": (">>=",),
    ">>=": ("<<=",),
    "&=": ("|=",),
    "|=": ("&=",),
    "^=": ("&=",),
    "++": ("--",),
    "--": ("++",),
}
COMPARISONS: Final = frozenset({"<", "<=", ">", ">=", "==", "!="})
DELETABLE: Final = frozenset({"expression_statement", "break_statement", "continue_statement"})
BODIES: Final = frozenset({"if_statement", "while_statement", "for_statement", "do_statement", "else_clause"})


def parse(source: bytes) -> Node:
    """Return the root of SOURCE's syntax tree."""
    return _PARSER.parse(source).root_node


def find_mutations(file: str, source: bytes) -> list[Mutation]:
    """Return all mutations of the C file FILE that reads SOURCE."""
    return mutations(file, source, list(_places(parse(source))))


def walk(node: Node) -> Iterator[Node]:
    """Yield NODE and all below it, but no preprocessor directives and no file-scope macros."""
    if node.type.startswith("preproc_") and node.type not in {"preproc_ifdef", "preproc_if", "preproc_else"}:
        return
    if node.type == "expression_statement" and _at_file_scope(node):
        return  # a DECL_ macro: tools/gen_dictionary.py reads it as text
    yield node
    for child in node.children:
        yield from walk(child)


def _at_file_scope(node: Node) -> bool:
    above = node.parent
    while above and above.type.startswith("preproc_"):
        above = above.parent
    return above is None or above.type == "translation_unit"


def _places(root: Node) -> Iterator[Place]:
    for node in walk(root):
        yield from _operators(node)
        yield from _literals(node)
        yield from _conditions(node)
        yield from _deletions(node)


def _operators(node: Node) -> Iterator[Place]:
    if node.type in {"binary_expression", "assignment_expression", "update_expression"}:
        operator = node.child_by_field_name("operator")
        if operator and (replacements := OPERATORS.get(operator.type)):
            yield Place(operator.start_byte, operator.end_byte, replacements)
    elif node.type == "unary_expression":
        operator = node.child_by_field_name("operator")
        if operator and operator.type in {"!", "-", "~"}:
            yield Place(operator.start_byte, operator.end_byte, ("",))


def _literals(node: Node) -> Iterator[Place]:
    text = node.text or b""
    if node.type in {"true", "false"}:
        yield Place(node.start_byte, node.end_byte, ("false" if node.type == "true" else "true",))
    if node.type != "number_literal":
        return
    if match := _INTEGER.fullmatch(text):
        number, suffix = int(match[1], 0), match[2].decode()
        # A longer array holds what a shorter one does: there only one element less is a change. 1 is mostly
        # a flag, for which 2 says the same.
        in_array = node.parent is not None and node.parent.type == "array_declarator"
        value = number - 1 if in_array else 0 if number == 1 else number + 1
        yield Place(node.start_byte, node.end_byte, (f"{value}{suffix}",))
    elif match := _FLOAT.fullmatch(text):
        real = float(match[1])
        yield Place(node.start_byte, node.end_byte, (f"{real + 1!r}{match[2].decode()}",))


def _conditions(node: Node) -> Iterator[Place]:
    if node.type not in {
        "if_statement",
        "while_statement",
        "do_statement",
        "for_statement",
        "conditional_expression",
    }:
        return
    condition = node.child_by_field_name("condition")
    if condition is None:
        return
    inner = condition
    if condition.type == "parenthesized_expression":
        inner = condition.named_children[0]
    operator = inner.child_by_field_name("operator") if inner.type == "binary_expression" else None
    if operator and operator.type in COMPARISONS:
        return  # the comparison's own mutations contain its negation
    text = (inner.text or b"").decode()
    yield Place(inner.start_byte, inner.end_byte, (f"!({text})",))


def _deletions(node: Node) -> Iterator[Place]:
    is_void = (node.text or b"").startswith(b"(void)")
    is_early_return = node.type == "return_statement" and not _is_last(node)
    if (node.type in DELETABLE and not is_void) or is_early_return:
        yield Place(node.start_byte, node.end_byte, (";",))


def _is_last(statement: Node) -> bool:
    """Whether STATEMENT is the last of its function's body."""
    block = statement.parent
    if block is None or block.type != "compound_statement" or block.parent is None:
        return False
    return block.parent.type == "function_definition" and block.named_children[-1] == statement


# ---------------------------------------------------------------------------------------------- statements


def statements(root: Node) -> list[Node]:
    """Return all statements within functions, outer ones before those they contain."""
    return [node for node in walk(root) if _is_statement(node)]


def _is_statement(node: Node) -> bool:
    parent = node.parent
    if parent is None or not node.is_named or node.type in {"comment", "case_statement", "else_clause"}:
        return False
    if parent.type == "compound_statement":
        return True
    if parent.type == "case_statement":
        return node != parent.child_by_field_name("value")
    fields = ("consequence", "body") if parent.type != "else_clause" else ()
    is_body = parent.type in BODIES and (
        parent.type == "else_clause" or any(parent.child_by_field_name(field) == node for field in fields)
    )
    return is_body and node.type != "compound_statement"


def statement_spans(source: bytes) -> list[tuple[int, int]]:
    """Return the first and last byte of every statement of SOURCE; its index is its counter's number."""
    return [(node.start_byte, node.end_byte) for node in statements(parse(source))]


def with_counters(source: bytes, first: int) -> bytes:
    """Return SOURCE with a mark set in mutation_hits[] by each statement, numbered from FIRST."""
    inserts: list[tuple[int, int, str]] = []
    for number, node in enumerate(statements(parse(source))):
        mark = f"mutation_hits[{first + number}] = 1; "
        parent = node.parent
        if parent is not None and parent.type in BODIES:
            inserts += [(node.start_byte, number, "{ " + mark), (node.end_byte, -number, " }")]
        else:
            inserts.append((node.start_byte, number, mark))
    out, at = b"extern unsigned char mutation_hits[]; ", 0
    for position, _, text in sorted(inserts):
        out += source[at:position] + text.encode()
        at = position
    return out + source[at:]
