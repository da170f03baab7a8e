"""Translation of `structs` definitions to C99: structs and functions in one header and one source, without allocation and with libm
alone.

Unsupported code raises ConfigError with the file and the line: the subset of Python stays small and explicit.
"""

from __future__ import annotations

import ast
import inspect
import io
import re
import tokenize
from collections.abc import Iterable, Sequence
from types import ModuleType
from typing import Any

from rotorwatch.base.compiling.body import Body, Function, Type, comment, is_struct, number
from rotorwatch.base.compiling.structs import EACH as EACH_KIND
from rotorwatch.base.compiling.structs import LISTS, SCALARS, snake
from rotorwatch.errors import ConfigError

HEAD = """#include <stdbool.h>
#include <stdint.h>

/* Define ROTORWATCH_FLOAT for single precision, in every file that includes this one. */
#ifndef ROTORWATCH_REAL
#define ROTORWATCH_REAL
#ifdef ROTORWATCH_FLOAT
typedef float rw_real;
#else
typedef double rw_real;
#endif
#endif

/* Seconds since any one moment, the same for all that is fed; long sums. Double in both precisions: after a day a float knows only 8 ms. */
#ifndef ROTORWATCH_TIME
#define ROTORWATCH_TIME
typedef double rw_time;
#endif
@EACH@/* Later than all times: the end of what lasts. */
#define RW_LASTS ((rw_time)1e30)
"""
EACH = """
/* So many stand side by side, and all are calculated at once, in vectors of the processor. */
#ifndef ROTORWATCH_EACH
#define ROTORWATCH_EACH
#ifndef RW_LANES
#define RW_LANES 1
#endif
#if RW_LANES > 1
typedef rw_real rw_each __attribute__((vector_size(RW_LANES * sizeof(rw_real)), aligned(sizeof(rw_real))));
#else
typedef rw_real rw_each;
#endif
#endif

"""
SIDE_BY_SIDE = """#if RW_LANES > 1
#pragma GCC diagnostic ignored "-Wpsabi" /* how vectors are passed matters only between libraries */
typedef __typeof__((rw_each){0} < (rw_each){0}) rw_which;
static inline rw_each each_of(rw_real a) { return a - (rw_each){0}; }
static inline rw_real one_each(rw_each a, int32_t k) { return a[k]; }
static inline rw_each replaced_each(rw_each a, int32_t k, rw_real b) { a[k] = b; return a; }
static inline rw_each choose_each(rw_which c, rw_each a, rw_each b) { return (rw_each)((c & (rw_which)a) | (~c & (rw_which)b)); }
static inline rw_each root_each(rw_each a) { for (int k = 0; k < RW_LANES; k++) { a[k] = RW_ROOT(a[k]); } return a; }
static inline rw_each exp_each(rw_each a) { for (int k = 0; k < RW_LANES; k++) { a[k] = RW_EXP(a[k]); } return a; }
static inline rw_each log_each(rw_each a) { for (int k = 0; k < RW_LANES; k++) { a[k] = RW_LOG(a[k]); } return a; }
#else
typedef bool rw_which;
static inline rw_each each_of(rw_real a) { return a; }
static inline rw_real one_each(rw_each a, int32_t k) { (void)k; return a; }
static inline rw_each replaced_each(rw_each a, int32_t k, rw_real b) { (void)a; (void)k; return b; }
static inline rw_each choose_each(rw_which c, rw_each a, rw_each b) { return c ? a : b; }
#define root_each RW_ROOT
#define exp_each RW_EXP
#define log_each RW_LOG
#endif
static inline rw_each min_each(rw_each a, rw_each b) { return choose_each(b < a, b, a); }
static inline rw_each max_each(rw_each a, rw_each b) { return choose_each(b > a, b, a); }
static inline rw_each abs_each(rw_each a) { return choose_each(a < each_of(0), -a, a); }

"""
HELPERS = """#ifdef ROTORWATCH_FLOAT
#define RW_ROOT sqrtf
#define RW_EXP expf
#define RW_LOG logf
#else
#define RW_ROOT sqrt
#define RW_EXP exp
#define RW_LOG log
#endif

static inline rw_real min_real(rw_real a, rw_real b) { return b < a ? b : a; }
static inline rw_real max_real(rw_real a, rw_real b) { return b > a ? b : a; }
static inline rw_real abs_real(rw_real a) { return a < 0 ? -a : a; }
static inline rw_time min_time(rw_time a, rw_time b) { return b < a ? b : a; }
static inline rw_time max_time(rw_time a, rw_time b) { return b > a ? b : a; }
static inline rw_time abs_time(rw_time a) { return a < 0 ? -a : a; }
static inline int32_t min_int(int32_t a, int32_t b) { return b < a ? b : a; }
static inline int32_t max_int(int32_t a, int32_t b) { return b > a ? b : a; }
static inline int32_t abs_int(int32_t a) { return a < 0 ? -a : a; }
"""


class Translation:
    """All definitions of some modules, in order of output. sizes: modules of integers that become macros; given: translations that these
    build on, which are in files of their own."""

    def __init__(self, modules: Sequence[ModuleType], *sizes: ModuleType, given: Sequence[Translation] = ()):
        self.modules = modules
        self.sizes = {k: v for m in sizes for k, v in vars(m).items() if k.isupper() and isinstance(v, int)}
        self.trees = {m: ast.parse(inspect.getsource(m)) for m in modules}
        self.lines = {m: inspect.getsource(m).splitlines() for m in modules}
        self.comments = {m: _comments("\n".join(self.lines[m])) for m in modules}
        self.fields: dict[type, dict[str, tuple[Type, ast.AST]]] = {k: v for one in given for k, v in one.fields.items()}
        self.home: dict[type, ModuleType] = {}
        self.functions: dict[Any, Function] = {k: f for one in given for k, f in one.functions.items()}
        self.tables: dict[str, str] = {}
        for module, tree in self.trees.items():
            for node in tree.body:
                if isinstance(node, ast.ClassDef) and is_struct(getattr(module, node.name)):
                    self._declare(module, node)
        for module, tree in self.trees.items():
            for node in tree.body:
                if isinstance(node, ast.FunctionDef):
                    self._sign(module, node, None)
                elif isinstance(node, ast.ClassDef) and is_struct(getattr(module, node.name)):
                    for method in node.body:
                        if isinstance(method, ast.FunctionDef):
                            self._sign(module, method, getattr(module, node.name))
        self.own = [f for f in self.functions.values() if f.module in self.trees]
        while any([self._mark(f) for f in self.own]):
            pass

    # Declarations

    def _declare(self, module: ModuleType, node: ast.ClassDef) -> None:
        kind, fields = getattr(module, node.name), {}
        for item in node.body:
            if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name):
                fields[item.target.id] = self.annotation(module, item.annotation), item
            elif isinstance(item, ast.Assign) and isinstance(item.targets[0], ast.Name):
                fields[item.targets[0].id] = self.field(module, item.value), item
        self.fields[kind], self.home[kind] = fields, module

    def field(self, module: ModuleType, node: ast.AST) -> Type:
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
            raise self.wrong(module, node, "a field is annotated, or made by array() or embedded()")
        first = node.args[0]
        assert isinstance(first, ast.Name)
        base = getattr(module, first.id)
        return Type(base, tuple(self._size(module, a) for a in node.args[1:]))

    def _size(self, module: ModuleType, node: ast.AST) -> str:
        if isinstance(node, ast.Name) and node.id in self.sizes:
            return f"RW_{node.id}"
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "packed":
            return f"({self._size(module, node.args[0])} / RW_LANES)"
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
            return f"({self._size(module, node.left)} * {self._size(module, node.right)})"
        return str(eval(compile(ast.Expression(node), "", "eval"), vars(module)))  # type: ignore[arg-type]  # of our own source

    def annotation(self, module: ModuleType, node: ast.AST | None) -> Type:
        if node is None or (isinstance(node, ast.Constant) and node.value is None):
            return Type("none")
        if isinstance(node, ast.Name):
            name = node.id
            if name in SCALARS:
                return Type(SCALARS[name])
            if name in LISTS:
                return Type(LISTS[name], ("",))
            if name == "Vectors":
                return Type("real", ("", "3"))
            if is_struct(getattr(module, name, None)):
                return Type(getattr(module, name))
        if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Name):  # list[Struct]
            return Type(getattr(module, node.slice.id), ("",))
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            return self.annotation(module, ast.parse(node.value, mode="eval").body)
        raise self.wrong(module, node, "this type is not known")

    def _sign(self, module: ModuleType, node: ast.FunctionDef, owner: type | None) -> None:
        parameters = {a.arg: Type(owner) if a.arg == "self" else self.annotation(module, a.annotation) for a in node.args.args}
        first = snake(owner.__name__) if owner else "rw_" + module.__name__.rpartition(".")[2]
        self.functions[(owner or module, node.name)] = Function(
            f"{first}_{node.name.strip('_')}", node, module, owner, parameters,
            result=self.annotation(module, node.returns), public=not node.name.startswith("_"),
        )  # fmt: skip

    def _mark(self, function: Function) -> bool:
        """Mark parameters that are changed; return whether one more was found."""
        before = len(function.changed)
        body = Body(self, function)
        body.emit()
        function.changed |= body.changed & set(function.parameters)
        return len(function.changed) > before

    @property
    def side_by_side(self) -> bool:
        """True if anything is calculated in several lanes."""
        return any(what.base == EACH_KIND for fields in self.fields.values() for what, _ in fields.values())

    # Text

    def header(self, about: str, includes: Sequence[str] = ("rw_config.h",), name: str = "front") -> str:
        """The header: types, structs, functions. name: of the definition, for the include guard."""
        guard = f"RW_{name.upper()}_H"
        included = [f'#include "{file}"' for file in includes]
        head = HEAD.replace("@EACH@", EACH.lstrip() if self.side_by_side else "")
        parts = [f"/* {about} */", f"#ifndef {guard}", f"#define {guard}", "", *included, head]
        for module, tree in self.trees.items():
            parts.append(comment(ast.get_docstring(tree) or ""))
            for name in _enumerated(tree):
                parts.append(f"#define RW_{name} {getattr(module, name)}")
            for kind in (k for k, home in self.home.items() if home is module):
                parts.append(self._struct(module, kind))
        parts.append('#ifdef __cplusplus\nextern "C" {\n#endif\n')
        for kind in self.home:
            parts.append(f"void {snake(kind.__name__)}_init({snake(kind.__name__)} *self);")
        for function in self.own:
            if function.public:
                parts.append("\n" + comment(ast.get_docstring(function.node) or "") + "\n" + self.signature(function) + ";")
        parts.append("\n#ifdef __cplusplus\n}\n#endif\n\n#endif\n")
        return "\n".join(parts)

    def _struct(self, module: ModuleType, kind: type) -> str:
        comments, rows = self.comments[module], []
        for name, (what, node) in self.fields[kind].items():
            note = comments.get(node.lineno, ("", False))[0]  # type: ignore[attr-defined]
            dims = "".join(f"[{d}]" for d in what.dims)
            rows.append(f"    {what.c} {name}{dims};" + (f" /* {note} */" if note else ""))
        return comment(inspect.getdoc(kind) or "") + "\ntypedef struct {\n" + "\n".join(rows) + f"\n}} {snake(kind.__name__)};\n"

    def source(self, header: str) -> str:
        """The source."""
        bodies = [Body(self, f).emit() for f in self.own]
        parts = [f'#include "{header}"\n\n#include <math.h>\n#include <string.h>\n', *self._helpers(bodies), ""]
        parts += self.tables.values()
        parts += [f"static {self.signature(f)};" for f in self.own if not f.public]
        parts += [self._init(kind) for kind in self.home]
        return "\n".join([*parts, "", *bodies])

    def _helpers(self, bodies: Iterable[str]) -> list[str]:
        """The helper functions that are called: unused ones would cause a warning."""
        lines = [*HELPERS.splitlines(), *(SIDE_BY_SIDE.splitlines() if self.side_by_side else [])]
        called = set(re.findall(r"\w+", "\n".join([*bodies, *map(self._init, self.home)])))
        kept: list[str] = []
        for _ in range(3):  # helpers call helpers
            kept = [x for x in lines if not x.startswith("static") or called & set(re.findall(r"\w+(?=\()", x)[:1])]
            called |= set(re.findall(r"\w+", "\n".join(x for x in kept if x.startswith("static"))))
        return kept

    def signature(self, f: Function) -> str:
        out = []
        for name, what in f.parameters.items():
            const = "" if name in f.changed or what.scalar else "const "
            if what.base == "text":
                out.append(f"const char *{name}")
                continue
            if what.dims:
                out.append(f"{const}{what.c} *{name}" if len(what.dims) == 1 else f"{what.c} (*{name})[{what.dims[1]}]")
            else:
                out.append(f"{const}{what.c} *{name}" if what.struct else f"{what.c} {name}")
        result = "void" if f.result.base == "none" else f.result.c
        return f"{result} {f.name}({', '.join(out) or 'void'})"

    def _init(self, kind: type) -> str:
        rows = ["    memset(self, 0, sizeof *self);"]
        for name, (what, _) in self.fields[kind].items():
            start: Any = kind._plain.get(name, kind._deep.get(name))  # type: ignore[attr-defined]
            if what.dims:
                if not what.struct and not start.fill:
                    continue
                loops = [f"for (int32_t i{d} = 0; i{d} < {size}; i{d}++) " for d, size in enumerate(what.dims)]
                place = name + "".join(f"[i{d}]" for d in range(len(what.dims)))
                rows.append("    " + "".join(loops) + self._start(what, f"self->{place}", getattr(start, "fill", None)))
            elif what.struct or start:
                rows.append("    " + self._start(what, f"self->{name}", start))
        name = snake(kind.__name__)
        return f"void {name}_init({name} *self)\n{{\n" + "\n".join(rows) + "\n}\n"

    def _start(self, what: Type, place: str, value: Any) -> str:
        if what.base == EACH_KIND:
            return f"{place} = each_of({number(value, 'real')});"
        return f"{what.c}_init(&{place});" if what.struct else f"{place} = {number(value, what.base)};"

    def wrong(self, module: ModuleType, node: ast.AST, why: str) -> ConfigError:
        return ConfigError(f"{module.__name__}, line {getattr(node, 'lineno', 0)}: {why} (base/compiling/structs.py says what can be C).")


def _enumerated(tree: ast.Module) -> Iterable[str]:
    """Names of module-level constants that are successive integers: A, B, C = 0, 1, 2."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            values = node.value.elts if isinstance(node.value, ast.Tuple) else []
            if values and all(isinstance(v, ast.Constant) and isinstance(v.value, int) for v in values):
                yield from (t.id for t in node.targets[0].elts if isinstance(t, ast.Name) and not t.id.startswith("_"))


def _comments(source: str) -> dict[int, tuple[str, bool]]:
    """Line -> (comment, whether it stands alone)."""
    found = {}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and "fmt:" not in token.string and "type: ignore" not in token.string:
            alone = not token.line[: token.start[1]].strip()
            found[token.start[0]] = token.string.lstrip("# ").replace("*/", "* /"), alone
    return found
