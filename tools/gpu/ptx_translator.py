"""PTX of one Warp module to C, a function that runs one thread (or one warp) for each kernel.

Approximate instructions (ex2, rcp, lg2 ...) become exact ones. A kernel with shuffles or matrix instructions runs a
warp at a time, statement by statement over its 32 lanes; lanes that part ways meet again. What exchanges values through
shared memory and barriers can't be translated.
"""

from __future__ import annotations

import collections
import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

_C_TYPES = {
    "pred": "uint8_t", "b8": "uint8_t", "u8": "uint8_t", "s8": "int8_t",
    "b16": "uint16_t", "u16": "uint16_t", "s16": "int16_t",
    "b32": "uint32_t", "u32": "uint32_t", "s32": "int32_t", "b64": "uint64_t", "u64": "uint64_t", "s64": "int64_t",
    "f32": "float", "f64": "double",
}  # fmt: skip
_WIDER = {"u16": "u32", "s16": "s32", "u32": "u64", "s32": "s64"}
_PRELUDE = r"""
#include <stdint.h>
#include <string.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#define LANES for (int l = 0; l < 32; ++l)
typedef struct { uint64_t low, high; } range_t;
typedef struct {
    char** params; uint32_t tid[3], ntid[3], ctaid[3], nctaid[3]; uint8_t* shared;
    const range_t* ranges; int range_count; int last; int64_t bad; uint64_t bad_address; uint64_t* counts;
} context_t;
static inline float as_f32(uint32_t x) { float f; memcpy(&f, &x, 4); return f; }
static inline double as_f64(uint64_t x) { double f; memcpy(&f, &x, 8); return f; }
static inline uint32_t bits_f32(float x) { uint32_t f; memcpy(&f, &x, 4); return f; }
static inline uint64_t bits_f64(double x) { uint64_t f; memcpy(&f, &x, 8); return f; }
static inline float down_f32(double x) { float f = (float)x; return (double)f > x ? nextafterf(f, -INFINITY) : f; }
static inline float up_f32(double x) { float f = (float)x; return (double)f < x ? nextafterf(f, INFINITY) : f; }
static inline float sat_f32(float x) { return x != x ? 0.0f : x < 0.0f ? 0.0f : x > 1.0f ? 1.0f : x; }
#define TO_INT(name, T, low, high) static inline T name(double x) { \
    if (x != x) return 0; if (x <= (double)low) return low; if (x >= (double)high) return high; return (T)x; }
TO_INT(to_s32, int32_t, INT32_MIN, INT32_MAX) TO_INT(to_s64, int64_t, INT64_MIN, INT64_MAX)
TO_INT(to_u32, uint32_t, 0, UINT32_MAX) TO_INT(to_u64, uint64_t, 0, UINT64_MAX)
TO_INT(to_s16, int16_t, INT16_MIN, INT16_MAX) TO_INT(to_u16, uint16_t, 0, UINT16_MAX)
TO_INT(to_u8, uint8_t, 0, UINT8_MAX) TO_INT(to_s8, int8_t, INT8_MIN, INT8_MAX)
/* Outside the arguments' arrays, and the module's constants: noted, and sent to a scratch page. */
static int in_globals(uint64_t address);
static uint8_t scratch[4096];
#ifdef CHECK
__attribute__((noinline))
#else
inline
#endif
static void* global_at(context_t* c, uint64_t address, int size) {
#ifdef CHECK
    if (c->ranges) {
        const range_t* r = c->ranges + c->last;
        if (address >= r->low && address + size <= r->high) return (void*)address;
        for (int n = 0; n < c->range_count; ++n)
            if (address >= c->ranges[n].low && address + size <= c->ranges[n].high) {
                c->last = n;
                return (void*)address;
            }
        if (in_globals(address)) return (void*)address;
        c->bad++; c->bad_address = address;
        return scratch;
    }
#endif
    return (void*)address;
}
"""


Handler = Callable[[list[str], str, list[str]], str]
"""From modifiers, type and operands of an instruction to C."""


class UnsupportedInstruction(NotImplementedError):
    """What needs the other threads of a block, or is not known here."""


@dataclass
class _Function:
    name: str
    params: list[str]
    result: str | None
    body: list[str]
    is_entry: bool
    blocks: list[collections.Counter] = field(default_factory=list)
    unsupported: str = ""
    by_warp: bool = False


class Translator:
    """PTX text of one module to C."""

    def __init__(self, text: str) -> None:
        text = re.sub(r"//[^\n]*", "", text.replace("\0", ""))
        self.globals: dict[str, str] = {}
        self.shared: dict[str, int] = {}
        self.functions: list[_Function] = []
        self._split(text)

    def _split(self, text: str) -> None:
        shared = 0
        head = re.compile(
            r"\.(?:global|const)\s+(?:\.align\s+\d+\s+)?\.(\w+)\s+([\w$]+)(?:\[(\d*)\])?(?:\s*=\s*([^;]+))?;"
        )
        # Only what kernels refer to is needed.
        code_from = min((m.start() for m in re.finditer(r"\.(?:visible \.entry|func)", text)), default=0)
        used = set(re.findall(r"[\w$]+", text[code_from:]))
        for match in head.finditer(text):
            kind, name, size, value = match.groups()
            if name in used:
                self.globals[name] = self._global(kind, name, size, value)
        for match in re.finditer(r"\.shared\s+(?:\.align\s+\d+\s+)?\.b8\s+([\w$]+)\[(\d+)\];", text):
            self.shared[match.group(1)] = shared
            shared += (int(match.group(2)) + 15) // 16 * 16
        self.shared_bytes = shared
        pattern = re.compile(
            r"(\.visible\s+\.entry|(?:\.visible\s+|\.weak\s+)?\.func)\s*(\([^)]*\))?\s*([\w$]+)\s*\(([^)]*)\)[^{;]*\{"
        )
        position = 0
        while found := pattern.search(text, position):
            kind, result, name, params = found.groups()
            depth, end = 1, found.end()
            while depth:
                depth += {"{": 1, "}": -1}.get(text[end], 0)
                end += 1
            body = text[found.end() : end - 1]
            names = [part.split()[-1].split("[")[0] for part in params.split(",") if part.strip()]
            returned = result.strip("() \n").split()[-1].split("[")[0] if result else None
            # One statement a line; braces of call sequences are no scopes of ours.
            statements = [
                s.strip() for s in re.split(r";|(?<=:)\s*\n", re.sub(r"\n\s*[{}]\s*\n", "\n", body)) if s.strip()
            ]
            self.functions.append(_Function(name, names, returned, statements, "entry" in kind))
            position = end

    def _global(self, kind: str, name: str, size: str | None, value: str | None) -> str:
        c_type = _C_TYPES[kind]
        if size is None:
            return f"static {c_type} {name} = {self._immediate(value.strip()) if value else 0};"
        values = ", ".join(self._immediate(v.strip()) for v in value.strip("{} ").split(",")) if value else "0"
        return f"static {c_type} {name}[{size or 1}] __attribute__((aligned(16))) = {{{values}}};"

    def source(self, name: str) -> str:
        """C of one kernel and of what it calls.

        Raises:
            UnsupportedInstruction: It can't be translated.
        """
        inside = [f"(a >= (uint64_t)&{name} && a < (uint64_t)&{name} + sizeof {name})" for name in self.globals]
        test = f"static int in_globals(uint64_t a) {{ return {' || '.join(inside) or '0'}; }}"
        parts, bodies = [_PRELUDE, *self.globals.values(), test], []
        for function in self.functions:
            if not function.is_entry:
                try:
                    bodies.append(self._function(function))
                    parts.append(self._head(function) + ";")
                except UnsupportedInstruction as error:
                    function.unsupported = str(error)
        (wanted,) = (function for function in self.functions if function.name == name)
        return "\n".join([*parts, *bodies, self._function(wanted)])

    def _head(self, function: _Function) -> str:
        if function.is_entry:
            return f"void {function.name}(context_t* c)"
        return f"static void {function.name}(context_t* c, char** P, char* result)"

    def _function(self, function: _Function) -> str:
        self.current = function
        function.by_warp = any(re.search(r"\b(mma|shfl)\.sync", statement) for statement in function.body)
        self.param_index = {name: n for n, name in enumerate(function.params)}
        self.locals: set[str] = set()
        self.buffers: set[str] = set()
        registers: list[str] = []
        lines: list[str] = []
        function.blocks = []
        numbers: dict[str, int] = {}

        def begin(label: str = "") -> None:
            function.blocks.append(collections.Counter())
            number = len(function.blocks) - 1
            if label:
                numbers[_label(label)] = number
            if function.by_warp:
                lines.append(
                    f"LANES if (m[l]) pc[l] = {number}; break; case {number}: COUNT({number})"
                    if number
                    else "case 0: COUNT(0)"
                )
            else:
                lines.append(f"{_label(label)}: COUNT({number})" if label else f"COUNT({number})")

        begin()
        for statement in function.body:
            if statement.endswith(":"):
                begin(statement[:-1])
                continue
            while match := re.match(r"(\$?[\w$]+):\s*", statement):
                begin(match.group(1))
                statement = statement[match.end() :]
            if not statement or statement in "{}":
                continue
            statement = statement.strip("{} \n") if not re.search(r"\{.*\}", statement, re.DOTALL) else statement
            if statement.startswith("."):
                registers += self._declaration(statement)
                continue
            lines.append(self._statement(statement))
            if re.match(r"(@!?%p\d+\s+)?bra", statement):
                begin()
        start = ["char** P = c->params;"] if function.is_entry else []
        if function.by_warp:
            # Lanes with the lowest block go first, so that those that part ways meet again.
            end = len(function.blocks)
            lines = [re.sub(r"@@(\w+)@@", lambda match: str(numbers[match.group(1)]), line) for line in lines]
            start.append("int pc[32] = {0}; uint8_t m[32];")
            lines = [
                f"for (;;) {{ int low = {end}; LANES if (pc[l] < low) low = pc[l]; if (low >= {end}) return;",
                "LANES m[l] = pc[l] == low; switch (low) {", *lines, f"LANES if (m[l]) pc[l] = {end}; break; }} }}",
            ]  # fmt: skip
        text = "\n  ".join([*start, *registers, *lines])
        return f"{self._head(function)} {{\n  (void)c; {text}\n  ;\n}}"

    def _declaration(self, statement: str) -> list[str]:
        match = re.match(r"\.reg\s+\.(\w+)\s+%(\w+)<(\d+)>", statement)
        if match:
            kind, prefix, count = match.groups()
            lanes, zero = ("[32]", "{0}") if self.current.by_warp else ("", "0")
            names = [f"{prefix}{n}" for n in range(1, int(count))]
            return [f"{_C_TYPES[kind]} {', '.join(f'{name}{lanes} = {zero}' for name in names)};"] if names else []
        if match := re.match(r"\.reg\s+\.(\w+)\s+%?(\w+)$", statement):
            if match.group(2) in self.buffers:
                return []
            self.buffers.add(match.group(2))
            lanes, zero = ("[32]", "{0}") if self.current.by_warp else ("", "0")
            return [f"{_C_TYPES[match.group(1)]} {match.group(2)}{lanes} = {zero};"]
        if match := re.match(r"\.local\s+\.align\s+\d+\s+\.b8\s+(\w+)\[(\d+)\]", statement):
            self.locals.add(match.group(1))
            lanes = "[32]" if self.current.by_warp else ""
            return [f"uint8_t {match.group(1)}{lanes}[{match.group(2)}] __attribute__((aligned(16)));"]
        if match := re.match(r"\.param\s+(?:\.align\s+\d+\s+)?\.(\w+)\s+(\w+)(?:\[(\d+)\])?$", statement):
            kind, name, size = match.groups()
            if name in self.buffers:
                return []
            self.buffers.add(name)
            return [f"char {name}[{max(int(size or 0), 16)}] __attribute__((aligned(16)));"]
        if statement.startswith((".pragma", ".loc", ".file", ".shared")):
            return []
        raise UnsupportedInstruction(statement)

    # One statement.

    def _statement(self, statement: str) -> str:
        guard = ""
        if match := re.match(r"@(!?)%(\w+)\s+", statement):
            guard = f"if ({match.group(1)}{self._register(match.group(2))}) "
            statement = statement[match.end() :]
        match = re.match(r"(\S+)\s*(.*)", statement, re.DOTALL)
        assert match
        op, rest = match.groups()
        self.current.blocks[-1][_class(op)] += 1
        text = self._operation(op, rest.strip())
        if not self.current.by_warp:
            return f"{guard}{{ {text} }}"
        if op.split(".")[0] in ("bra", "ret", "exit"):
            target = f"@@{_label(rest)}@@" if op.startswith("bra") else str(1 << 30)
            # The rest of the lanes goes on to the next block, which begins behind a branch.
            return f"LANES if (m[l]) {{ {guard}{{ pc[l] = {target}; m[l] = 0; }} }}"
        if op.startswith(("mma.", "shfl.")):
            if guard:
                raise UnsupportedInstruction(f"{op} under a condition")
            return f"{{ int n = 0; LANES n += m[l]; if (n != 32) {{ c->bad++; c->bad_address = 2; return; }} {text} }}"
        return f"LANES if (m[l]) {guard}{{ {text} }}"

    def _register(self, name: str) -> str:
        return f"{name}[l]" if self.current.by_warp else name

    def _operation(self, op: str, rest: str) -> str:
        base, *mods = op.split(".")
        arguments = _split_arguments(rest)
        kind = mods[-1] if mods else ""
        name = f"_{base}"
        if base in ("bar", "vote", "wgmma", "barrier", "activemask", "match", "redux", "ldmatrix", "brx"):
            raise UnsupportedInstruction(op)
        handler = getattr(self, name, None)
        if handler is None:
            raise UnsupportedInstruction(op)
        return handler(mods, kind, arguments)

    def _value(self, text: str, kind: str) -> str:
        """An operand as a value of a PTX type."""
        text = text.strip()
        c_type = _C_TYPES[kind]
        if text.startswith("%"):
            register = text[1:]
            lane = " + l" if self.current.by_warp else ""
            special = re.match(r"(tid|ntid|ctaid|nctaid)\.([xyz])$", register)
            if special:
                own = lane if special.group(0) == "tid.x" else ""
                return f"({c_type})(c->{special.group(1)}[{'xyz'.index(special.group(2))}]{own})"
            if register == "laneid":
                return f"({c_type})((c->tid[0]{lane}) & 31)"
            # Registers without a type of their own may hold a float, and the other way round.
            is_float, wants_float = register[0] == "f", kind in ("f32", "f64")
            place = self._register(register)
            if is_float and not wants_float:
                return f"bits_{'f64' if register.startswith('fd') else 'f32'}({place})"
            if wants_float and not is_float:
                return f"as_{kind}({place})"
            return f"({c_type}){place}"
        if text in self.shared:
            return str(self.shared[text])
        if text in self.globals:
            return f"(uint64_t)(uintptr_t)&{text}"
        if text in self.locals:
            return f"(uint64_t)(uintptr_t){self._register(text)}"
        if text in self.param_index:
            return f"(uint64_t)(uintptr_t)P[{self.param_index[text]}]"
        return f"({c_type}){self._immediate(text)}"

    @staticmethod
    def _immediate(text: str) -> str:
        if text.startswith("0f"):
            return _literal(struct.unpack("<f", struct.pack("<I", int(text[2:], 16)))[0], "f")
        if text.startswith("0d"):
            return _literal(struct.unpack("<d", struct.pack("<Q", int(text[2:], 16)))[0], "")
        number = int(text.rstrip("U"), 0)
        return f"({number}ll)" if -(2**63) <= number < 2**63 else f"({number}ull)"

    def _set(self, target: str, kind: str, expression: str) -> str:
        register = target.strip()[1:]
        place = self._register(register)
        if register.startswith("fd") and kind != "f64":
            return f"{place} = as_f64({expression});"
        if register[0] == "f" and not register.startswith("fd") and kind != "f32":
            return f"{place} = as_f32({expression});"
        if register[0] != "f" and kind == "f32":
            return f"{place} = bits_f32({expression});"
        if register[0] != "f" and kind == "f64":
            return f"{place} = bits_f64({expression});"
        return f"{place} = {expression};"

    def _address(self, text: str) -> tuple[str, str]:
        """Symbol or register, and offset, of an address in brackets."""
        match = re.match(r"\[\s*([%\w$]+)\s*(?:\+\s*(-?\d+))?\s*\]$", text)
        if not match:
            raise UnsupportedInstruction(f"address {text}")
        return match.group(1), match.group(2) or "0"

    def _pointer(self, space: str, text: str, size: int) -> str:
        base, offset = self._address(text)
        if space == "param":
            if base in self.param_index:
                return f"(P[{self.param_index[base]}] + {offset})"
            if base in self.buffers:
                return f"({base} + {offset})"
            if base == self.current.result:
                return f"(result + {offset})"
            if base.startswith("%"):  # the address of a struct
                return f"((char*)(uintptr_t)({self._value(base, 'u64')} + {offset}))"
            raise UnsupportedInstruction(f"parameter {base}")
        if space == "shared":
            return f"(c->shared + {self._value(base, 'u32')} + {offset})"
        address = f"{self._value(base, 'u64')} + {offset}"
        if space == "local" or base in self.locals or base in self.globals:
            return f"((char*)(uintptr_t)({address}))"
        return f"global_at(c, {address}, {size})"

    @staticmethod
    def _space(mods: list[str]) -> str:
        return next((m for m in mods if m in ("param", "shared", "global", "local", "const")), "generic")

    def _ld(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        size = _size(kind)
        targets = _registers(arguments[0])
        pointer = self._pointer(self._space(mods), arguments[1], size * len(targets))
        lines = [f"const char* a = (const char*){pointer};"]
        for n, target in enumerate(targets):
            lines.append(
                f"{{ {_C_TYPES[kind]} v; memcpy(&v, a + {n * size}, {size}); {self._set(target, kind, 'v')} }}"
            )
        return " ".join(lines)

    def _st(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        size = _size(kind)
        sources = _registers(arguments[1])
        pointer = self._pointer(self._space(mods), arguments[0], size * len(sources))
        lines = [f"char* a = (char*){pointer};"]
        for n, source in enumerate(sources):
            lines.append(f"{{ {_C_TYPES[kind]} v = {self._value(source, kind)}; memcpy(a + {n * size}, &v, {size}); }}")
        return " ".join(lines)

    def _mov(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        target, source = arguments
        if source.startswith("{"):
            parts = _registers(source)
            width = 8 * _size(kind) // len(parts)
            pieces = [f"((uint64_t){self._value(part, f'b{width}')} << {n * width})" for n, part in enumerate(parts)]
            return self._set(target, kind, f"({_C_TYPES[kind]})({' | '.join(pieces)})")
        if target.startswith("{"):
            parts = _registers(target)
            width = 8 * _size(kind) // len(parts)
            whole = self._value(source, kind)
            return " ".join(
                [f"uint64_t w = {whole};"]
                + [
                    self._set(p, f"b{width}", f"({_C_TYPES[f'b{width}']})(w >> {n * width})")
                    for n, p in enumerate(parts)
                    if p != "_"
                ]
            )
        return self._set(target, kind, self._value(source, kind))

    def _cvta(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._set(arguments[0], "u64", self._value(arguments[1], "u64"))

    def _binary(self, symbol: str) -> Handler:
        def operation(mods: list[str], kind: str, arguments: list[str]) -> str:
            a, b = (self._value(x, kind) for x in arguments[1:3])
            expression = f"({_C_TYPES[kind]})({a} {symbol} {b})"
            if kind in ("f32", "f64"):
                expression = f"({a} {symbol} {b})"
                if "sat" in mods:
                    expression = f"sat_f32({expression})"
            return self._set(arguments[0], kind, expression)

        return operation

    def _add(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._binary("+")(mods, kind, arguments)

    def _sub(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._binary("-")(mods, kind, arguments)

    def _and(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._binary("&")(mods, kind, arguments)

    def _or(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._binary("|")(mods, kind, arguments)

    def _xor(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._binary("^")(mods, kind, arguments)

    def _not(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        value = self._value(arguments[1], kind)
        return self._set(arguments[0], kind, f"!{value}" if kind == "pred" else f"({_C_TYPES[kind]})~{value}")

    def _mul(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        if kind in ("f32", "f64"):
            return self._binary("*")(mods, kind, arguments)
        a, b = (self._value(x, kind) for x in arguments[1:3])
        if "wide" in mods:
            wide = _WIDER[kind]
            return self._set(arguments[0], wide, f"({_C_TYPES[wide]})((__int128){a} * (__int128){b})")
        if "hi" in mods:
            return self._set(
                arguments[0], kind, f"({_C_TYPES[kind]})(((__int128){a} * (__int128){b}) >> {8 * _size(kind)})"
            )
        return self._set(arguments[0], kind, f"({_C_TYPES[kind]})((uint64_t){a} * (uint64_t){b})")

    def _mad(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        a, b = (self._value(x, kind) for x in arguments[1:3])
        if "wide" in mods:
            wide = _WIDER[kind]
            sum_ = f"(__int128){a} * (__int128){b} + {self._value(arguments[3], wide)}"
            return self._set(arguments[0], wide, f"({_C_TYPES[wide]})({sum_})")
        if kind in ("f32", "f64"):
            return self._fma(mods, kind, arguments)
        c = self._value(arguments[3], kind)
        if "hi" in mods:
            raise UnsupportedInstruction("mad.hi")
        return self._set(arguments[0], kind, f"({_C_TYPES[kind]})((uint64_t){a} * (uint64_t){b} + (uint64_t){c})")

    def _fma(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        a, b, c = (self._value(x, kind) for x in arguments[1:4])
        if kind == "f64":
            return self._set(arguments[0], kind, f"fma({a}, {b}, {c})")
        exact = f"((double){a} * (double){b} + (double){c})"
        rounded = {"rm": f"down_f32({exact})", "rp": f"up_f32({exact})"}
        expression = next((rounded[m] for m in mods if m in rounded), f"fmaf({a}, {b}, {c})")
        return self._set(arguments[0], kind, f"sat_f32({expression})" if "sat" in mods else expression)

    def _div(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        a, b = (self._value(x, kind) for x in arguments[1:3])
        if kind in ("f32", "f64"):
            return self._set(arguments[0], kind, f"({a} / {b})")
        return self._set(arguments[0], kind, f"{b} == 0 ? ({_C_TYPES[kind]})-1 : ({_C_TYPES[kind]})({a} / {b})")

    def _rem(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        a, b = (self._value(x, kind) for x in arguments[1:3])
        return self._set(arguments[0], kind, f"{b} == 0 ? {a} : ({_C_TYPES[kind]})({a} % {b})")

    def _neg(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._set(arguments[0], kind, f"({_C_TYPES[kind]})(-{self._value(arguments[1], kind)})")

    def _abs(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        value = self._value(arguments[1], kind)
        function = {"f32": "fabsf", "f64": "fabs"}.get(kind)
        return self._set(
            arguments[0], kind, f"{function}({value})" if function else f"({value} < 0 ? -{value} : {value})"
        )

    def _extreme(self, sign: str, name: str, mods: list[str], kind: str, arguments: list[str]) -> str:
        a, b = (self._value(x, kind) for x in arguments[1:3])
        if kind in ("f32", "f64"):
            return self._set(arguments[0], kind, f"{name}{'f' if kind == 'f32' else ''}({a}, {b})")
        return self._set(arguments[0], kind, f"({a} {sign} {b} ? {a} : {b})")

    def _min(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._extreme("<", "fmin", mods, kind, arguments)

    def _max(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._extreme(">", "fmax", mods, kind, arguments)

    def _shl(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        a, n = self._value(arguments[1], kind), self._value(arguments[2], "u32")
        return self._set(arguments[0], kind, f"{n} > {8 * _size(kind) - 1} ? 0 : ({_C_TYPES[kind]})({a} << {n})")

    def _shr(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        a, n = self._value(arguments[1], kind), self._value(arguments[2], "u32")
        bits = 8 * _size(kind)
        if kind.startswith("s"):
            return self._set(arguments[0], kind, f"({_C_TYPES[kind]})({a} >> ({n} > {bits - 1} ? {bits - 1} : {n}))")
        return self._set(arguments[0], kind, f"{n} > {bits - 1} ? 0 : ({_C_TYPES[kind]})({a} >> {n})")

    def _selp(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        a, b = (self._value(x, kind) for x in arguments[1:3])
        return self._set(arguments[0], kind, f"{self._value(arguments[3], 'pred')} ? {a} : {b}")

    def _setp(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        a, b = (self._value(x, kind) for x in arguments[1:3])
        compare, *extra = mods[:-1]
        unsigned = {"lo": "lt", "ls": "le", "hi": "gt", "hs": "ge"}
        symbol = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
        if kind in ("f32", "f64"):
            if compare in ("num", "nan"):
                test = f"({a} == {a} && {b} == {b})"
                test = test if compare == "num" else f"!{test}"
            elif compare.endswith("u"):
                test = f"({a} != {a} || {b} != {b} || {a} {symbol[compare[:-1]]} {b})"
            elif compare == "ne":
                test = f"({a} == {a} && {b} == {b} && {a} != {b})"
            else:
                test = f"({a} {symbol[compare]} {b})"
        else:
            test = f"({a} {symbol[unsigned.get(compare, compare)]} {b})"
        extra = [m for m in extra if m in ("and", "or", "xor")]
        if extra:
            other = arguments[3]
            value = f"!{self._value(other[1:], 'pred')}" if other.startswith("!") else self._value(other, "pred")
            test = f"({test} {dict(zip(('and', 'or', 'xor'), '&|^', strict=True))[extra[0]]} {value})"
        first, _, second = arguments[0].partition("|")
        text = f"uint8_t t = {test}; {self._register(first.strip()[1:])} = t;"
        return text + (f" {self._register(second.strip()[1:])} = !t;" if second else "")

    def _cvt(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        target, source = mods[-2], mods[-1]
        value = self._value(arguments[1], source)
        floats = ("f32", "f64")
        rounding = {"rzi": "trunc", "rni": "nearbyint", "rmi": "floor", "rpi": "ceil"}
        if source in floats and target not in floats:
            rounded = next(rounding[m] for m in mods if m in rounding)
            return self._set(arguments[0], target, f"to_{target}({rounded}({value}))")
        if source in floats and target in floats:
            function = next((rounding[m] for m in mods if m in rounding), None)
            if function:
                value = f"{function}({value})"
            expression = f"({_C_TYPES[target]}){value}"
            return self._set(arguments[0], target, f"sat_f32({expression})" if "sat" in mods else expression)
        if target in floats:
            return self._set(arguments[0], target, f"({_C_TYPES[target]}){value}")
        return f"{self._register(arguments[0].strip()[1:])} = ({_C_TYPES[target]}){value};"

    def _unary(self, single: str, double: str) -> Handler:
        def operation(mods: list[str], kind: str, arguments: list[str]) -> str:
            value = self._value(arguments[1], kind)
            return self._set(arguments[0], kind, (single if kind == "f32" else double).format(value))

        return operation

    def _rcp(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._unary("(1.0f / {})", "(1.0 / {})")(mods, kind, arguments)

    def _sqrt(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._unary("sqrtf({})", "sqrt({})")(mods, kind, arguments)

    def _rsqrt(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._unary("(1.0f / sqrtf({}))", "(1.0 / sqrt({}))")(mods, kind, arguments)

    def _ex2(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._unary("exp2f({})", "exp2({})")(mods, kind, arguments)

    def _lg2(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._unary("log2f({})", "log2({})")(mods, kind, arguments)

    def _sin(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._unary("sinf({})", "sin({})")(mods, kind, arguments)

    def _cos(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._unary("cosf({})", "cos({})")(mods, kind, arguments)

    def _copysign(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        sign, size = (self._value(x, kind) for x in arguments[1:3])
        return self._set(arguments[0], kind, f"copysign{'f' if kind == 'f32' else ''}({size}, {sign})")

    def _bfi(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        a, b = (self._value(x, kind) for x in arguments[1:3])
        at, length = (self._value(x, "u32") for x in arguments[3:5])
        return f"uint64_t m = ({length} >= 64 ? ~0ull : ((1ull << {length}) - 1)) << {at}; " + self._set(
            arguments[0], kind, f"({_C_TYPES[kind]})((((uint64_t){a} << {at}) & m) | ((uint64_t){b} & ~m))"
        )

    def _bfe(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        a = self._value(arguments[1], kind.replace("s", "u"))
        at, length = (self._value(x, "u32") for x in arguments[2:4])
        if kind.startswith("s"):
            raise UnsupportedInstruction("bfe of a signed number")
        return self._set(arguments[0], kind, f"({_C_TYPES[kind]})(((uint64_t){a} >> {at}) & ((1ull << {length}) - 1))")

    def _popc(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return self._set(arguments[0], "u32", f"__builtin_popcountll({self._value(arguments[1], kind)})")

    def _clz(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        value, bits = self._value(arguments[1], kind), 8 * _size(kind)
        return self._set(
            arguments[0], "u32", f"{value} == 0 ? {bits} : __builtin_clzll((uint64_t){value}) - {64 - bits}"
        )

    def _atom(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        has_target = len(arguments) > 2
        target = arguments[0] if has_target else None
        address, *values = arguments[1:] if has_target else arguments
        space = next((m for m in mods if m in ("global", "shared")), "generic")
        pointer = self._pointer(space, address, _size(kind))
        c_type = _C_TYPES[kind]
        operation = next(m for m in mods if m in ("add", "min", "max", "exch", "cas", "and", "or", "xor", "inc", "dec"))
        v = [self._value(x, kind) for x in values]
        new = {
            "add": f"({c_type})(o + {v[0]})", "min": f"(o < {v[0]} ? o : {v[0]})", "max": f"(o > {v[0]} ? o : {v[0]})",
            "exch": v[0], "cas": f"(o == {v[0]} ? {v[-1]} : o)", "and": f"({c_type})(o & {v[0]})",
            "or": f"({c_type})(o | {v[0]})", "xor": f"({c_type})(o ^ {v[0]})",
        }  # fmt: skip
        if kind in ("f32", "f64") and operation not in ("add", "exch"):
            raise UnsupportedInstruction(f"atom.{operation}.{kind}")
        if operation not in new:
            raise UnsupportedInstruction(f"atom.{operation}")
        text = f"char* a = (char*){pointer}; {c_type} o, n; memcpy(&o, a, sizeof o); n = {new[operation]}; "
        text += "memcpy(a, &n, sizeof n); "
        return text + (self._set(target, kind, "o") if target else "")

    _red = _atom

    def _shfl(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        how = next(m for m in mods if m in ("bfly", "idx", "down", "up"))
        first, _, second = arguments[0].partition("|")
        source = {"bfly": "l ^ n", "idx": "n", "down": "(l + n < 32 ? l + n : l)", "up": "(l >= n ? l - n : l)"}[how]
        n = self._value(arguments[2], "s32")
        text = f"uint32_t was[32]; LANES was[l] = {self._value(arguments[1], 'b32')}; "
        text += f"LANES {{ const int n = {n}; {self._set(first.strip(), 'b32', f'was[{source}]')} }} "
        return text + (f"LANES {self._register(second.strip()[1:])} = 1;" if second else "")

    def _mma(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        if "m16n8k8" not in mods or mods.count("tf32") != 2:
            raise UnsupportedInstruction(f"mma.{'.'.join(mods)}")
        d, a, b, old = (_registers(argument) for argument in arguments)
        lines = ["float A[16][8], B[8][8], D[16][8];"]
        for n, register in enumerate(a):
            value = f"as_f32({self._value(register, 'b32')} & 0xffffe000u)"
            lines.append(f"LANES A[(l >> 2) + {8 * (n % 2)}][(l & 3) + {4 * (n // 2)}] = {value};")
        for n, register in enumerate(b):
            lines.append(f"LANES B[(l & 3) + {4 * n}][l >> 2] = as_f32({self._value(register, 'b32')} & 0xffffe000u);")
        places = [f"D[(l >> 2) + {8 * (n // 2)}][2 * (l & 3) + {n % 2}]" for n in range(4)]
        lines += [
            f"LANES {place} = {self._value(register, 'f32')};" for place, register in zip(places, old, strict=True)
        ]
        lines.append("for (int i = 0; i < 16; ++i) for (int j = 0; j < 8; ++j) {")
        lines.append(
            "double s = D[i][j]; for (int k = 0; k < 8; ++k) s += (double)A[i][k] * B[k][j]; D[i][j] = (float)s; }"
        )
        lines += [f"LANES {self._set(register, 'f32', place)}" for place, register in zip(places, d, strict=True)]
        return " ".join(lines)

    def _membar(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return ""

    _fence = _membar

    def _bra(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return f"goto {_label(arguments[0])};"

    def _ret(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return "return;"

    _exit = _ret

    def _trap(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        return "c->bad++; return;"

    def _call(self, mods: list[str], kind: str, arguments: list[str]) -> str:
        match = re.match(r"(?:\(([\w$]+)\)\s*,\s*)?([\w$]+)\s*,\s*\(([^)]*)\)", ", ".join(arguments))
        if not match:
            raise UnsupportedInstruction(f"call {arguments}")
        result, name, params = match.groups()
        called = next((function for function in self.functions if function.name == name), None)
        if called is None or called.unsupported:
            # The rare path of a library function, such as the sine of a huge angle: taking it is an error.
            return "c->bad++; c->bad_address = 0;"
        given = [p.strip() for p in params.split(",") if p.strip()]
        return f"char* given[] = {{{', '.join(given) or '0'}}}; {name}(c, given, {result or '0'});"


def _literal(number: float, suffix: str) -> str:
    """A C constant of exactly this value."""
    if math.isnan(number):
        return "NAN"
    if math.isinf(number):
        return "INFINITY" if number > 0 else "(-INFINITY)"
    return f"({number.hex()}{suffix})"


def _size(kind: str) -> int:
    return int(kind[1:]) // 8


def _label(text: str) -> str:
    return text.strip().replace("$", "")


def _registers(text: str) -> list[str]:
    return [part.strip() for part in text.strip("{} ").split(",")]


def _split_arguments(text: str) -> list[str]:
    parts, depth, part = [], 0, ""
    for character in text:
        depth += {"{": 1, "}": -1, "[": 1, "]": -1, "(": 1, ")": -1}.get(character, 0)
        if character == "," and depth == 0:
            parts.append(part.strip())
            part = ""
        else:
            part += character
    return [*parts, part.strip()] if part.strip() else parts


def _class(op: str) -> str:
    """What an instruction occupies."""
    base, *mods = op.split(".")
    kind = mods[-1] if mods else ""
    if base in ("ld", "st", "atom", "red"):
        space = Translator._space(mods)
        width = next((m for m in mods if m in ("v2", "v4")), "")
        return f"{base}.{space}" + (f".{width}" if width else "")
    if base == "mma":
        return "mma"
    if kind == "f64" or "f64" in mods:
        return "f64"
    if kind == "f32" and base in ("fma", "mul", "add", "sub", "mad"):
        return "fma.f32" if base in ("fma", "mad") else "add/mul.f32"
    if base in ("ex2", "lg2", "rcp", "sqrt", "rsqrt", "sin", "cos") or (base == "div" and kind == "f32"):
        return "special"
    if base in ("bra", "ret", "call"):
        return "branch"
    return "other"
