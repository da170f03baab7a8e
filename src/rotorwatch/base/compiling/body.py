"""Functions of definitions as C: statements, expressions and their types."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from rotorwatch.base.compiling import structs
from rotorwatch.base.compiling.structs import snake
from rotorwatch.errors import ConfigError

if TYPE_CHECKING:
    from rotorwatch.base.compiling.translate import Translation

C_NAMES = {
    "real": "rw_real",
    "time": "rw_time",
    "each": "rw_each",
    "int": "int32_t",
    "flag": "bool",
    "mask": "uint16_t",
    "small": "int16_t",
    "letter": "char",
    "byte": "uint8_t",
    "text": "const char *",
}
RANK = {"flag": 0, "ilit": 0, "text": 0, "int": 1, "lit": 2, "real": 3, "time": 4, "each": 5}
WIDE: dict[Any, Any] = {"mask": "int", "small": "int", "letter": "int", "byte": "int"}  # types of stored numbers when read
FIRST = {"lit": "real", "ilit": "int", **WIDE}  # type of a variable by its first value
OPEN, CLOSE = "\x02", "\x03"  # around a number in a text, as long as its precision is open
BINARY = {ast.Add: ("+", 6), ast.Sub: ("-", 6), ast.Mult: ("*", 7), ast.Div: ("/", 7), ast.Mod: ("%", 7), ast.FloorDiv: ("/", 7)}
BITS = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^", ast.LShift: "<<", ast.RShift: ">>"}  # of whole numbers
MODULO = {"sum32": "+", "difference32": "-", "shift32": "<<"}  # of whole numbers, of 32 bits
ROUNDED = {"sqrt": "RW_ROOT", "exp": "RW_EXP", "log": "RW_LOG"}  # of a number in the library's precision
EACH = {"sqrt": "root_each", "exp": "exp_each", "log": "log_each"}  # the same for each lane
COMPARE = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
BUILTIN = (
    *ROUNDED, "isnan", "floor", "abs", "min", "max", "int", "float", "real", "len", "ord", "reset", "copy", "local", "each", "one",
    "replaced", *MODULO,
)  # fmt: skip


@dataclass(frozen=True)
class Type:
    """base: real, time, each, int, flag, which (a comparison of `each`), byte, lit, ilit, none, or a Struct; dims: of an array, in C, the
    first empty where unknown."""

    base: Any
    dims: tuple[str, ...] = ()

    @property
    def scalar(self) -> bool:
        return not self.dims and not self.struct

    @property
    def struct(self) -> bool:
        return isinstance(self.base, type)

    @property
    def c(self) -> str:
        return snake(self.base.__name__) if self.struct else C_NAMES[self.base]


@dataclass
class Code:
    """An expression in C: text, type, how tightly it binds (larger binds tighter), and whether it is a pointer to a Struct."""

    text: str
    type: Type
    tight: int = 20
    pointer: bool = False
    root: str = ""  # the parameter or variable that it is part of

    def within(self, least: int) -> str:
        return self.text if self.tight >= least else f"({self.text})"


@dataclass
class Function:
    """A method or function. const: parameters that it does not change."""

    name: str
    node: ast.FunctionDef
    module: ModuleType
    owner: type | None
    parameters: dict[str, Type]
    result: Type
    public: bool
    changed: set[str] = field(default_factory=set)


def comment(text: str) -> str:
    """Text as a comment in C."""
    return f"/* {text.replace('*/', '* /')} */" if text else ""


def is_struct(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, structs.Struct)


def number(value: Any, base: str) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if base in ("int", "ilit", "flag", *WIDE):
        return str(int(value))
    if value != value:
        text = "NAN"
    elif abs(value) == structs.LASTS:
        text = "RW_LASTS" if value > 0 else "-RW_LASTS"
    elif abs(value) == float("inf"):
        text = "INFINITY" if value > 0 else "-INFINITY"
    elif base == "time":
        return exact(float(value))
    else:
        text = repr(float(value))
    return f"(rw_real){text}" if base == "real" else OPEN + text + CLOSE if base == "lit" and text[-1].isdigit() else text


def exact(value: float) -> str:
    """A finite number in double precision, also where the compiler treats constants as single precision: an integer over a power of ten is
    rounded once, as the number itself would be."""
    with np.errstate(over="ignore"):
        if float(np.float32(value)) == value:
            return f"(rw_time){value!r}"
    sign, digits, power = Decimal(repr(value)).as_tuple()
    whole = int("".join(map(str, digits)))
    assert isinstance(power, int)
    if not (-22 <= power < 0 and whole <= 2**53):
        raise ConfigError(f"{value!r} cannot be written as a whole number over a power of ten in C.")
    return f"({'-' * sign}(rw_time){whole} / {10**-power})"


def settled(text: str, time: bool) -> str:
    """The text with numbers of open precision in double precision, or as they are."""
    return re.sub(f"{OPEN}(.*?){CLOSE}", lambda m: exact(float(m[1])) if time else m[1], text)


class Body:
    """A function in C."""

    def __init__(self, all_: Translation, function: Function):
        self.all, self.function, self.module = all_, function, function.module
        self.types: dict[str, Type] = dict(function.parameters)
        self.pointers = {n for n, t in function.parameters.items() if t.struct and not t.dims}
        self.alias: dict[str, str] = {}  # local pointer -> parameter or variable that it points into
        self.changed: set[str] = set()
        self.hoisted: dict[str, str] = {}
        self.loops: set[str] = set()
        self.shown = function.node.lineno
        self.at: ast.AST = function.node  # the statement that is written

    def emit(self) -> str:
        """The definition."""
        f = self.function
        body = f.node.body[1:] if ast.get_docstring(f.node) is not None else f.node.body
        lines = self.block(body, 1, top=True)
        doc = comment(ast.get_docstring(f.node) or "") if not f.public else ""
        head = ("static " if not f.public else "") + self.all.signature(f)
        hoisted = [f"    {text}" for text in self.hoisted.values()]
        return settled("\n".join([*([doc] if doc else []), head, "{", *hoisted, *lines, "}", ""]), False)

    def wrong(self, node: ast.AST, why: str) -> ConfigError:
        return self.all.wrong(self.module, node, why)

    # Statements

    def block(self, body: Sequence[ast.stmt], depth: int, top: bool = False) -> list[str]:
        lines: list[str] = []
        for statement in body:
            comments = self.all.comments[self.module]
            pad = "    " * depth
            for line in range(self.shown + 1, statement.lineno):
                if line in comments and comments[line][1]:
                    lines.append(f"{pad}/* {comments[line][0]} */")
            self.shown = max(self.shown, statement.lineno)
            made = self.statement(statement, depth, top)
            note = comments.get(statement.lineno)
            if note and not note[1] and made:
                made[0] += f" /* {note[0]} */"
            lines += [pad + line for line in made]
        return lines

    def statement(self, node: ast.stmt, depth: int, top: bool) -> list[str]:
        self.at = node
        if isinstance(node, ast.Assign):
            if len(node.targets) > 1:  # a = b = value
                last = self.assign(node.targets[-1], node.value, top)
                return [last, *(self.assign(t, node.targets[-1], top) for t in reversed(node.targets[:-1]))]
            return [self.assign(node.targets[0], node.value, top)]
        if isinstance(node, ast.AnnAssign):
            assert node.value is not None
            return [self.assign(node.target, node.value, top, self.all.annotation(self.module, node.annotation))]
        if isinstance(node, ast.AugAssign):
            target, value = self.expression(node.target), self.expression(node.value)
            self.change(target.root)
            whole = target.type.base in ("int", *WIDE)
            if type(node.op) not in BINARY and (type(node.op) not in BITS or not whole):
                raise self.wrong(node, "this operation is not C")
            sign = BITS[type(node.op)] if type(node.op) in BITS else BINARY[type(node.op)][0]
            if target.type.base in WIDE:
                return [f"{target.text} = ({target.type.c})({target.text} {sign} {self.cast(value, Type('int'))});"]
            return [f"{target.text} {sign}= {self.cast(value, target.type)};"]
        if isinstance(node, ast.Return):
            return ["return;" if node.value is None else f"return {self.cast(self.expression(node.value), self.function.result)};"]
        if isinstance(node, ast.Break | ast.Continue):
            return ["break;" if isinstance(node, ast.Break) else "continue;"]
        if isinstance(node, ast.Pass):
            return []
        if isinstance(node, ast.Expr):
            return [self.expression(node.value).text + ";"]
        if isinstance(node, ast.If):
            return self.condition(node, depth)
        if isinstance(node, ast.While | ast.For) and node.orelse:
            raise self.wrong(node, "a loop has no else")
        if isinstance(node, ast.While):
            head = f"while ({self.condition_of(node, self.expression(node.test)).text}) {{"
            return [head, *self.inner(node.body, depth), "}"]
        if isinstance(node, ast.For):
            return self.loop(node, depth)
        raise self.wrong(node, f"{type(node).__name__} is not C")

    def inner(self, body: Sequence[ast.stmt], depth: int) -> list[str]:
        pad = len("    " * depth)
        return [line[pad:] for line in self.block(body, depth + 1)]

    def condition(self, node: ast.If, depth: int) -> list[str]:
        test = self.condition_of(node, self.expression(node.test))
        lines = [f"if ({test.text}) {{", *self.inner(node.body, depth)]
        if len(node.orelse) == 1 and isinstance(node.orelse[0], ast.If):
            rest = self.condition(node.orelse[0], depth)
            return [*lines, "} else " + rest[0], *rest[1:]]
        if node.orelse:
            lines += ["} else {", *self.inner(node.orelse, depth)]
        return [*lines, "}"]

    def condition_of(self, node: ast.AST, test: Code) -> Code:
        if test.type.base == "which":
            raise self.wrong(node, "what differs from one to the next side by side may choose a number, no more")
        return test

    def loop(self, node: ast.For, depth: int) -> list[str]:
        if not (isinstance(node.target, ast.Name) and isinstance(node.iter, ast.Call) and getattr(node.iter.func, "id", "") == "range"):
            raise self.wrong(node, "a loop is over range()")
        name, ends = node.target.id, [self.expression(a).text for a in node.iter.args]
        if name in self.types and name not in self.loops:
            raise self.wrong(node, f"{name} is a variable already")
        self.types[name] = Type("int")
        self.loops.add(name)
        down = len(ends) == 3
        if down and ends[2] != "-1":
            raise self.wrong(node, "a loop counts by 1 or -1")
        first, last = ("0", ends[0]) if len(ends) == 1 else (ends[0], ends[1])
        test = f"{name} > {last}; {name}--" if down else f"{name} < {last}; {name}++"
        return [f"for (int32_t {name} = {first}; {test}) {{", *self.inner(node.body, depth), "}"]

    def assign(self, target: ast.expr, value: ast.expr, top: bool, wanted: Type | None = None) -> str:
        if isinstance(target, ast.Name):
            return self.variable(target, value, top, wanted)
        to = self.expression(target)
        self.change(to.root)
        if not to.type.scalar:
            raise self.wrong(target, "copy() copies a struct")
        return f"{to.text} = {self.cast(self.expression(value), to.type)};"

    def variable(self, target: ast.Name, value: ast.expr, top: bool, wanted: Type | None) -> str:
        name, known = target.id, self.types.get(target.id)
        if isinstance(value, ast.Call) and isinstance(value.func, ast.Name):
            if value.func.id == "local":
                what = self.all.field(self.module, value)
                self.types[name] = what
                dims = "".join(f"[{d}]" for d in what.dims)
                self.hoisted[name] = f"{what.c} {name}{dims};"
                loop = f"memset({name}, 0, sizeof {name});"
                return loop if not what.struct else f"for (int32_t i = 0; i < {what.dims[0]}; i++) {what.c}_init(&{name}[i]);"
            made = getattr(self.module, value.func.id, None)
            if isinstance(made, type) and is_struct(made):
                self.types[name] = Type(made)
                self.hoisted[name] = f"{snake(made.__name__)} {name};"
                return f"{snake(made.__name__)}_init(&{name});"
        got = self.condition_of(target, self.expression(value))
        if "text" in (got.type.base, wanted.base if wanted else ""):
            raise self.wrong(target, "a text is passed on, not kept")
        if not got.type.scalar:  # another name for part of a struct
            self.types[name], self.alias[name] = Type(got.type.base, ("",) if got.type.dims else ()), got.root
            if got.type.struct and not got.type.dims:
                self.pointers.add(name)
            const = "" if got.root in self.function.changed or got.root not in self.function.parameters else "const "
            text = got.text if got.type.dims or got.pointer else f"&{got.within(15)}"
            self.hoisted.setdefault(name, f"{const}{got.type.c} *{name};")
            return f"{name} = {text};"
        if name in self.loops:
            raise self.wrong(target, f"{name} is what a loop counts by")
        if known is None:
            base = FIRST.get(got.type.base, got.type.base)
            known = self.types[name] = wanted or Type(base)
            if top:
                return f"{known.c} {name} = {self.cast(got, known)};"
            nothing = {"flag": "false", "each": "each_of(0)"}.get(known.base, "0")
            self.hoisted[name] = f"{known.c} {name} = {nothing};"
        return f"{name} = {self.cast(got, known)};"

    def change(self, root: str) -> None:
        while root in self.alias:
            root = self.alias[root]
        self.changed.add(root)

    # Expressions

    def cast(self, code: Code, wanted: Type) -> str:
        have, want = WIDE.get(code.type.base, code.type.base), wanted.base
        if have == "which" or (have == "each" and want != "each"):
            raise self.wrong(self.at, f"{code.text} is of several side by side, and one is wanted")
        if want in WIDE and code.type.base != want:
            return f"({C_NAMES[want]}){code.within(14)}"
        if have == want or code.type.base == want or not code.type.scalar:
            return code.text
        if want == "each":
            return f"each_of({self.cast(code, Type('real'))})"
        if have in ("lit", "ilit"):
            return self.literal(code, want)
        if want == "flag":
            return code.text
        if RANK[have] != RANK[want]:
            # A whole number that a call returns is not cast as it is: PX4 takes that for a mistake (-Wbad-function-cast).
            called = have == "int" and code.tight == 20 and code.text.endswith(")")
            return f"({C_NAMES[want]})(0 + {code.text})" if called else f"({C_NAMES[want]}){code.within(14)}"
        return code.text

    def literal(self, code: Code, want: str) -> str:
        if want == "real" or (want == "time" and code.type.base == "ilit"):  # 1 / 2 is a half
            return f"({C_NAMES[want]}){settled(code.within(14), False)}"
        return settled(code.within(14), True) if want == "time" else code.text

    def expression(self, node: ast.AST) -> Code:
        method = getattr(self, f"on_{type(node).__name__.lower()}", None)
        if method is None:
            raise self.wrong(node, f"{type(node).__name__} is not C")
        return method(node)

    def on_constant(self, node: ast.Constant) -> Code:
        value = node.value
        if isinstance(value, bool):
            return Code("true" if value else "false", Type("flag"))
        if isinstance(value, str):
            return Code('"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"', Type("text"))
        if not isinstance(value, int | float):
            raise self.wrong(node, f"{value!r} is no number")
        base = "ilit" if isinstance(value, int) else "lit"
        return Code(number(value, base), Type(base))

    def on_name(self, node: ast.Name) -> Code:
        name = node.id
        if name in self.types:
            what = self.types[name]
            return Code(name, what, 20, what.struct and not what.dims and name in self.pointers, name)
        if name in self.all.sizes:
            if getattr(self.module, name, None) != self.all.sizes[name]:
                raise self.wrong(node, f"{name} is the name of a size, and another number here")
            return Code(f"RW_{name}", Type("int"))
        value = getattr(self.module, name, None)
        if isinstance(value, bool):
            return Code("true" if value else "false", Type("flag"))
        if name == "LANES":
            return Code("RW_LANES", Type("int"))
        if name == "LASTS":
            return Code("RW_LASTS", Type("time"))
        if isinstance(value, int | float):
            base = "ilit" if isinstance(value, int) else "lit"
            return Code(number(value, base), Type(base), 20 if value >= 0 else 14)
        if isinstance(value, tuple):
            table = f"rw_{self.module.__name__.rpartition('.')[2]}_{name.strip('_').lower()}"
            numbers = ", ".join(number(v, "real") for v in value)
            self.all.tables[table] = f"static const rw_real {table}[{len(value)}] = {{{numbers}}};"
            return Code(table, Type("real", (str(len(value)),)))
        raise self.wrong(node, f"{name} is not known")

    def on_attribute(self, node: ast.Attribute) -> Code:
        base = self.expression(node.value)
        fields = self.all.fields.get(base.type.base) if base.type.struct else None
        if not fields or node.attr not in fields:
            raise self.wrong(node, f"{node.attr} is no field of {base.text}")
        what = fields[node.attr][0]
        return Code(f"{base.within(15)}{'->' if base.pointer else '.'}{node.attr}", what, 20, False, base.root)

    def on_subscript(self, node: ast.Subscript) -> Code:
        base, index = self.expression(node.value), self.expression(node.slice)
        if base.type.base == "text":
            return Code(f"{base.within(15)}[{index.text}]", Type("letter"))
        if not base.type.dims:
            raise self.wrong(node, f"{base.text} is no array")
        if base.type.base == "byte":
            return Code(f"{base.within(15)}[{index.text}]", Type("int"), 20, False, base.root)
        return Code(f"{base.within(15)}[{index.text}]", Type(base.type.base, base.type.dims[1:]), 20, False, base.root)

    def on_unaryop(self, node: ast.UnaryOp) -> Code:
        one = self.expression(node.operand)
        if isinstance(node.op, ast.Not):
            return Code(f"!{one.within(14)}", Type("flag"), 14)
        what = Type(WIDE.get(one.type.base, one.type.base))
        if isinstance(node.op, ast.USub):
            return Code(f"-{one.within(15)}", what, 14)
        if isinstance(node.op, ast.Invert) and what.base in ("int", "ilit"):
            return Code(f"~{one.within(14)}", what, 14)
        raise self.wrong(node, "this sign is not C")

    def join(self, a: Code, b: Code) -> Type:
        base = max((WIDE.get(x.type.base, x.type.base) for x in (a, b)), key=RANK.__getitem__)
        if base == "lit" and {a.type.base, b.type.base} & {"int", *WIDE}:
            base = "real"
        return Type("int" if base == "flag" and a.type.base != b.type.base else base)

    def operand(self, code: Code, what: Type, tight: int) -> str:
        if code.type.base == what.base or (what.base == "lit" and code.type.base == "ilit"):
            return code.within(tight)
        # In C a number beside a vector counts for each of its elements.
        text = self.cast(code, what if what.base != "each" else Type("real"))
        return text if text != code.text or code.tight >= tight else f"({text})"

    def on_binop(self, node: ast.BinOp) -> Code:
        if isinstance(node.op, ast.Pow):
            raise self.wrong(node, "write a product instead of a power")
        if type(node.op) not in BINARY and type(node.op) not in BITS:
            raise self.wrong(node, "this operation is not C")
        left, right = self.expression(node.left), self.expression(node.right)
        if type(node.op) in BITS:
            what = self.join(left, right)
            if what.base not in ("int", "ilit"):
                raise self.wrong(node, "bits are of whole numbers")
            return Code(f"({left.within(15)} {BITS[type(node.op)]} {right.within(15)})", what)
        sign, tight = BINARY[type(node.op)]
        what = self.join(left, right)
        if isinstance(node.op, ast.Div) and what.base in ("int", "ilit"):
            what = Type("time")
        return Code(f"{self.operand(left, what, tight)} {sign} {self.operand(right, what, tight + 1)}", what, tight)

    def on_compare(self, node: ast.Compare) -> Code:
        parts, sides = [], [node.left, *node.comparators]
        for k, op in enumerate(node.ops):
            if type(op) not in COMPARE:
                raise self.wrong(node, "this comparison is not C")
            left, right = self.expression(sides[k]), self.expression(sides[k + 1])
            what = self.join(left, right)
            if what.base == "each":
                if len(node.ops) > 1:
                    raise self.wrong(node, "compare those side by side one by one")
                sign = COMPARE[type(op)]
                return Code(f"{self.cast(left, what)} {sign} {self.cast(right, what)}", Type("which"), 4)
            parts.append(f"{self.operand(left, what, 6)} {COMPARE[type(op)]} {self.operand(right, what, 6)}")
        return Code(" && ".join(parts), Type("flag"), 4 if len(parts) == 1 else 2)

    def on_boolop(self, node: ast.BoolOp) -> Code:
        sides = [self.expression(v) for v in node.values]
        sign, tight = ("&&", 2) if isinstance(node.op, ast.And) else ("||", 1)
        if all(side.type.base == "which" for side in sides):
            return Code(f" {sign[0]} ".join(f"({side.text})" for side in sides), Type("which"), tight)
        return Code(f" {sign} ".join(self.condition_of(node, side).within(3) for side in sides), Type("flag"), tight)

    def on_ifexp(self, node: ast.IfExp) -> Code:
        test, yes, no = self.expression(node.test), self.expression(node.body), self.expression(node.orelse)
        what = self.join(yes, no)
        if test.type.base == "which":
            what = Type("each")
            return Code(f"choose_each({test.text}, {self.cast(yes, what)}, {self.cast(no, what)})", what)
        if what.base == "each":
            return Code(f"{test.within(3)} ? {self.cast(yes, what)} : {self.cast(no, what)}", what, 0)
        return Code(f"{test.within(3)} ? {self.operand(yes, what, 1)} : {self.operand(no, what, 1)}", what, 0)

    def on_call(self, node: ast.Call) -> Code:
        if node.keywords:
            raise self.wrong(node, "arguments have no names")
        if isinstance(node.func, ast.Name) and node.func.id in BUILTIN:
            return self.builtin(node, node.func.id)
        if isinstance(node.func, ast.Name):
            target = getattr(self.module, node.func.id, None)
            home = inspect.getmodule(target)
            function = self.all.functions.get((home, node.func.id))
            return self.call(node, function, [])
        assert isinstance(node.func, ast.Attribute)
        if isinstance(node.func.value, ast.Name) and isinstance(getattr(self.module, node.func.value.id, None), ModuleType):
            return self.call(node, self.all.functions.get((getattr(self.module, node.func.value.id), node.func.attr)), [])
        base = self.expression(node.func.value)
        return self.call(node, self.all.functions.get((base.type.base, node.func.attr)), [base])

    def call(self, node: ast.Call, function: Function | None, first: list[Code]) -> Code:
        if function is None:
            raise self.wrong(node, f"{ast.unparse(node.func)} is no definition")
        arguments = [*first, *(self.expression(a) for a in node.args)]
        if len(arguments) != len(function.parameters):
            raise self.wrong(node, f"{function.name} takes {len(function.parameters)} arguments")
        texts = []
        for code, (name, what) in zip(arguments, function.parameters.items()):
            if what.scalar:
                texts.append(self.cast(code, what))
                continue
            if name in function.changed or len(what.dims) > 1:
                self.change(code.root)
            texts.append(code.text if what.dims or code.pointer else f"&{code.within(15)}")
        return Code(f"{function.name}({', '.join(texts)})", function.result)

    def builtin(self, node: ast.Call, name: str) -> Code:
        arguments = [self.expression(a) for a in node.args] if name != "local" else []
        first = arguments[0]
        if name in MODULO:
            if any(g.type.base not in ("int", "ilit") for g in arguments):
                raise self.wrong(node, f"{name} is of whole numbers")
            last = f"(uint32_t){arguments[1].within(14)}" if name != "shift32" else arguments[1].within(14)
            return Code(f"(int32_t)((uint32_t){first.within(14)} {MODULO[name]} {last})", Type("int"), 14)
        if name in ("reset", "copy"):
            self.change(first.root)
            at = [g.text if g.pointer else f"&{g.within(15)}" for g in arguments]
            if name == "reset":
                return Code(f"{first.type.c}_init({at[0]})", Type("none"))
            return Code(f"*{at[0]} = *{at[1]}" if arguments[1].pointer else f"*{at[0]} = {arguments[1].text}", Type("none"), 0)
        if name == "len" and first.type.base == "text":
            return Code(f"(int32_t)strlen({first.text})", Type("int"), 14)
        if name == "ord":
            return first
        if name == "isnan":
            return Code(f"isnan({first.text})", Type("flag"))
        if name == "each":
            return Code(self.cast(first, Type("each")), Type("each"))
        if name in ("one", "replaced"):
            numbers = (Type("each"), Type("int"), Type("real"))
            given = ", ".join(self.cast(g, what) for g, what in zip(arguments, numbers))
            return Code(f"{name}_each({given})", Type("real" if name == "one" else "each"))
        if name in EACH and first.type.base == "each":
            return Code(f"{EACH[name]}({first.text})", Type("each"))
        if name in ("int", "float", "real"):
            what = Type({"int": "int", "float": "time", "real": "real"}[name])
            fixed = first.type.base == "lit" and what.base == "int"  # of a number that is written out, the whole part
            return Code(f"(int32_t){first.within(14)}" if fixed else self.cast(first, what), what, 14)
        if name in ROUNDED or name == "floor":
            own = first.type.base == "real"
            called = ROUNDED[name] if own and name != "floor" else name
            return Code(f"{called}({self.cast(first, Type('real' if own else 'time'))})", Type("real" if own else "time"))
        if name == "abs":
            what = Type(FIRST.get(first.type.base, first.type.base))
            return Code(f"abs_{what.base}({self.cast(first, what)})", what)
        what = self.join(*arguments)
        what = Type(FIRST.get(what.base, what.base))
        return Code(f"{name}_{what.base}({', '.join(self.cast(g, what) for g in arguments)})", what)
