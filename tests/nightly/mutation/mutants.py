"""The mutants of a Python file: copies of it with one small fault each.

The faults are made by the operators of mutmut (``mutmut.mutation.mutators``). mutmut's own runner
is not used, because it omits decorated functions, default values of dataclasses and constants of
modules. These contain the numbers of the paper.
"""

import ast
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import takewhile

import libcst as cst
import libcst.matchers as m
from libcst.metadata import MetadataWrapper, ParentNodeProvider, PositionProvider
from mutmut.mutation import mutators

#: Nodes that are never mutated. A fault in an annotation or an import has no effect, or the file
#: cannot be imported. A `raise` contains the text of a message: the tests check that an error is
#: raised, but not its complete text.
_SKIPPED = (cst.Annotation, cst.Decorator, cst.Import, cst.ImportFrom, cst.Raise, cst.Assert)
#: Patterns of nodes that are not mutated either: `__all__`; `strict=True`, which is an assertion;
#: other texts of messages.
_NEVER = (
    m.Assign(targets=[m.AssignTarget(m.Name("__all__"))])
    | m.Arg(keyword=m.Name("strict"))
    | m.Call(m.Name(m.MatchRegex(r".*Error")))
    | m.Call(m.Attribute(m.Name("logger")))
)
#: Calls whose arguments are not removed or replaced: each such call would fail.
_WHOLE_CALLS = {"len", "isinstance", "range", "super", "zip"}


@dataclass(frozen=True)
class Mutant:
    """One fault in one file.

    Attributes:
        file: the file, relative to the package.
        line: number of the first changed line, counted from 1.
        lines: a test can detect the fault only if it executes one of these lines; None for code
            outside of functions, which is executed by the import.
        was, becomes: the changed lines before and after the change, without indentation.
        source: the whole file with the fault.
    """

    file: str
    line: int
    lines: range | None
    was: str
    becomes: str
    source: bytes

    def diff(self) -> str:
        """The fault as readable text: the place, and the lines before and after."""
        lines = [f"{self.file}:{self.line}"]
        lines += [f"  - {line}" for line in self.was.splitlines()]
        lines += [f"  + {line}" for line in self.becomes.splitlines()]
        return "\n".join(lines)


def _smaller_number(node: cst.Float) -> Iterator[cst.Float]:
    """1.6 → 1.5. mutmut adds 1 instead, which tests of a small constant detect too easily."""
    if node.evaluated_value:
        yield node.with_changes(value=repr(node.evaluated_value * 0.9375))


def _no_statement(node: cst.Expr) -> Iterator[cst.BaseSmallStatement]:
    """``f(x)`` → ``pass``, for calls whose result is not used."""
    if isinstance(node.value, cst.Call):
        yield cst.Pass()


def _arguments(node: cst.Call) -> Iterator[cst.Call]:
    """Removes or replaces arguments, as mutmut does, but does not remove ``device=``.

    Without this argument, a tensor is on the CPU, where the tests run: no test can detect that.
    """
    devices = [arg for arg in node.args if arg.keyword and arg.keyword.value == "device"]
    for changed in mutators.operator_arg_removal(node):
        if all(arg in changed.args for arg in devices):
            yield changed


def _string(node: cst.BaseString) -> Iterator[cst.BaseString]:
    """The first of the three strings that mutmut makes: it adds letters.

    The other two change only upper and lower case.
    """
    yield from list(mutators.operator_string(node))[:1]


_REPLACED = {mutators.operator_string: _string, mutators.operator_arg_removal: _arguments}
_OPERATORS = [
    *((kind, _REPLACED.get(operator, operator)) for kind, operator in mutators.mutation_operators),
    (cst.Float, _smaller_number),
    (cst.Expr, _no_statement),
]


def mutants_of(file: str, source: bytes) -> list[Mutant]:
    """All mutants of ``source`` that parse and differ from it and from each other."""
    visitor = _Visitor()
    wrapper = MetadataWrapper(cst.parse_module(source))
    wrapper.visit(visitor)
    found: dict[bytes, Mutant] = {}
    for node, changed in visitor.changes:
        mutated = cst.ensure_type(wrapper.module.deep_replace(node, changed), cst.Module).bytes
        if mutated not in found and mutated != source and _parses(mutated):
            line, was, becomes = _changed_lines(source, mutated)
            lines = _executed_lines(wrapper, node)
            found[mutated] = Mutant(file, line, lines, was, becomes, mutated)
    return list(found.values())


def _parses(source: bytes) -> bool:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ast.parse(source)
    except SyntaxError:
        return False
    return True


class _Visitor(cst.CSTVisitor):
    """Collects pairs of a node and a changed node that replaces it."""

    METADATA_DEPENDENCIES = (PositionProvider, ParentNodeProvider)

    def __init__(self) -> None:
        super().__init__()
        self.changes: list[tuple[cst.CSTNode, cst.CSTNode]] = []
        self._of_a_gpu: set[cst.CSTNode | None] = set()

    def on_visit(self, node: cst.CSTNode) -> bool:
        if isinstance(node, _SKIPPED) or _is_docstring(node) or _asks_for_device(node):
            return False
        if node in self._of_a_gpu or m.matches(node, _NEVER):
            return False
        if isinstance(node, cst.If | cst.IfExp) and _asks_for_device(node.test):
            self._of_a_gpu |= {_branch_of_a_gpu(node), node.test}
            return True
        whole = isinstance(node, cst.Call) and getattr(node.func, "value", None) in _WHOLE_CALLS
        for kind, operator in _OPERATORS:
            if isinstance(node, kind) and not whole:
                changes = (changed for changed in operator(node) if not _equal(node, changed))
                self.changes += [(node, changed) for changed in changes]
        return True


def _equal(node: cst.CSTNode, changed: cst.CSTNode) -> bool:
    """Whether two float literals have the same value, such as 1e38 and 1e38 + 1."""
    return (
        isinstance(node, cst.Float)
        and isinstance(changed, cst.Float)
        and node.evaluated_value == changed.evaluated_value
    )


def _is_docstring(node: cst.CSTNode) -> bool:
    return isinstance(node, cst.Expr) and isinstance(
        node.value, cst.SimpleString | cst.ConcatenatedString
    )


def _asks_for_device(node: cst.CSTNode) -> bool:
    """Whether a node is a comparison such as ``x.device.type == "cpu"``.

    It is not mutated, because its value is always the same in the tests, which run on the CPU.
    """
    device = m.Name("device") | m.Attribute(attr=m.Name("device"))
    return m.matches(node, m.Comparison(left=m.Attribute(attr=m.Name("type"), value=device)))


def _branch_of_a_gpu(node: cst.If | cst.IfExp) -> cst.CSTNode | None:
    comparison = cst.ensure_type(node.test, cst.Comparison).comparisons[0]
    is_cpu = m.matches(comparison, m.ComparisonTarget(m.Equal(), m.SimpleString('"cpu"')))
    is_gpu = m.matches(comparison, m.ComparisonTarget(m.NotEqual(), m.SimpleString('"cpu"')))
    is_gpu |= m.matches(comparison, m.ComparisonTarget(m.Equal(), m.SimpleString('"cuda"')))
    return node.orelse if is_cpu else node.body if is_gpu else None


def _changed_lines(before: bytes, after: bytes) -> tuple[int, str, str]:
    """Number of the first changed line, from 1, and the changed lines before and after."""
    was, becomes = before.decode().splitlines(), after.decode().splitlines()
    first = _common(was, becomes)
    last = _common(was[first:][::-1], becomes[first:][::-1])
    return first + 1, *(
        "\n".join(line.strip() for line in lines[first : len(lines) - last])
        for lines in (was, becomes)
    )


def _common(a: list[str], b: list[str]) -> int:
    """How many lines at the start are the same."""
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(a, b, strict=False)))


def _executed_lines(wrapper: MetadataWrapper, node: cst.CSTNode) -> range | None:
    """The value of `Mutant.lines`: the lines of the node and of the simple statement around it."""
    positions = wrapper.resolve(PositionProvider)
    parents = wrapper.resolve(ParentNodeProvider)
    statement: cst.CSTNode | None = None
    inner = node
    while (parent := parents.get(inner)) is not None:
        if isinstance(inner, cst.BaseSmallStatement) and statement is None:
            statement = inner
        if isinstance(parent, cst.FunctionDef):
            # Default values of parameters are evaluated by the import.
            if inner is not parent.body:
                return None
            spans = [positions[n] for n in (node, statement) if n is not None and n in positions]
            return range(min(s.start.line for s in spans), max(s.end.line for s in spans) + 1)
        inner = parent
    return None
