"""A small interpreter of Structured Text, for tests: as much of IEC 61131-3 as the compensator's blocks use, in Python.

It is strict: whole numbers, reals and Booleans don't mix, whole numbers keep the range of their type, an index that of
its array, and every word must be declared or known. How a real becomes a whole number is the test's choice.
"""

import math
import re

RANGES = {"SINT": 7, "INT": 15, "DINT": 31, "LINT": 63}
_WORD = re.compile(r"\d+\.\d+(?:E-?\d+)?|\d+|[A-Za-z_]\w*(?:\.\w+)?|<=|>=|<>|:=|[-+*/()\[\],=<>]|\S")
_STATEMENT = re.compile(
    r"\s*(?:(?P<if>IF|ELSIF|WHILE)\b(?P<condition>.*?)\b(?:THEN|DO)\b|(?P<else>ELSE)\b|(?P<end>END_(?:IF|FOR|WHILE));"
    r"|FOR\s+(?P<over>\w+)\s*:=(?P<first>.*?)\bTO\b(?P<last>.*?)(?:\bBY\b(?P<by>.*?))?\bDO\b|(?P<return>RETURN);"
    r"|(?P<call>\w+)\s*\((?P<given>[^;]*)\);|(?P<place>\w+(?:\[[^;]*?\])?)\s*:=(?P<value>[^;]*);)",
    re.DOTALL,
)


class Whole(int):
    """A whole number, which only others like it meet; its quotient is whole."""

    def _with(self, other, made):
        assert type(other) is Whole, f"{self} and {other!r} are of two types"
        return Whole(made)

    def __add__(self, other):
        return self._with(other, int(self) + int(other))

    def __sub__(self, other):
        return self._with(other, int(self) - int(other))

    def __mul__(self, other):
        return self._with(other, int(self) * int(other))

    def __truediv__(self, other):
        return self._with(other, math.trunc(int(self) / int(other)))

    def __neg__(self):
        return Whole(-int(self))


def _expression(text, names):
    """Python's for an expression."""
    made = []
    for word in _WORD.findall(text):
        low = word.lower()
        if re.fullmatch(r"\d+", word):
            made.append(f"Whole({word})")
        elif word in ("AND", "OR", "NOT", "TRUE", "FALSE"):
            made.append({"TRUE": "True", "FALSE": "False"}.get(word, low))
        elif word in FUNCTIONS:
            made.append(f"F[{word!r}]")
        elif re.match(r"[A-Za-z_]", word):
            assert low.split(".")[0] in names, f"{word} is not declared"
            made.append("self." + low)
        else:
            assert word in {*"-+*/()[],<>=", "<=", ">="} or word[0].isdigit(), f"{word} is not known"
            made.append({"=": "=="}.get(word, word))
    return " ".join(made)


def _real(value):
    assert type(value) is float
    return value


FUNCTIONS = (
    "ABS",
    "SQRT",
    "DINT_TO_LREAL",
    "LINT_TO_LREAL",
    "LREAL_TO_DINT",
    "LREAL_TO_LINT",
    "SINT_TO_DINT",
    "INT_TO_DINT",
)


class _Array(list):
    def __getitem__(self, at):
        assert type(at) is Whole
        assert 0 <= at < len(self)
        return super().__getitem__(int(at))

    def __setitem__(self, at, value):
        assert type(value) is type(self[at])
        super().__setitem__(int(at), value)


def blocks(text, rounded):
    """Classes of the function blocks of a text; `rounded` makes a whole number of a real."""
    text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.DOTALL)
    types = dict(
        re.findall(r"(\w+)\s*:\s*(ARRAY[^;]*);", "".join(re.findall(r"\bTYPE\b(.*?)END_TYPE", text, re.DOTALL)))
    )
    functions = {
        "ABS": lambda v: abs(_real(v)),
        "SQRT": lambda v: math.sqrt(_real(v)),
        "SINT_TO_DINT": Whole,
        "INT_TO_DINT": Whole,
        **dict.fromkeys(("DINT_TO_LREAL", "LINT_TO_LREAL"), lambda v: float(_whole(v))),
        **dict.fromkeys(("LREAL_TO_DINT", "LREAL_TO_LINT"), lambda v: Whole(rounded(_real(v)))),
    }
    made = {}
    for name, inside in re.findall(r"FUNCTION_BLOCK (\w+)(.*?)END_FUNCTION_BLOCK", text, re.DOTALL):
        made[name] = _block(name, inside, types, functions, made)
    return made


def _whole(value):
    assert type(value) is Whole
    return int(value)


def _value(kind, text, types, made):
    """The initial value of a variable of a type."""
    kind = types.get(kind, kind)
    if array := re.match(r"ARRAY \[0\.\.(\d+)\] OF (\w+)", kind):
        words = re.findall(r"[^\s,\[\]]+", text or "") or [""] * (int(array[1]) + 1)
        assert len(words) == int(array[1]) + 1
        return _Array(_value(array[2], word, types, made) for word in words)
    if kind == "LREAL":
        assert not text or re.fullmatch(r"\s*-?\d+\.\d+(E-?\d+)?\s*", text), text
        return float(text or 0.0)
    if kind == "BOOL":
        return {"": False, "TRUE": True, "FALSE": False}[(text or "").strip()]
    if kind in RANGES:
        assert abs(int(text or 0)) < 1 << RANGES[kind]
        return Whole(text or 0)
    return made[kind]()


def _block(name, inside, types, functions, made):
    declared, at = {}, 0
    for section in re.finditer(r"\bVAR(?:_INPUT|_OUTPUT| CONSTANT)?\b(.*?)END_VAR", inside, re.DOTALL):
        for one, kind, start in re.findall(r"(\w+)\s*:(?!=)\s*([^:;]*?)\s*(?::=([^;]*))?;", section[1]):
            assert one.lower() not in declared, f"{one} is declared twice"
            declared[one.lower()] = (kind, start)
        at = section.end()
    lines, depth, body = ["def body(self):"], 1, inside[at:]
    while body.strip():
        found = _STATEMENT.match(body)
        assert found, body[:80]
        part = found.groupdict()
        if part["end"] or part["else"] or part["if"] == "ELSIF":
            depth -= 1
        if part["if"]:
            word = {"ELSIF": "elif"}.get(part["if"], part["if"].lower())
            lines.append("    " * depth + f"{word} {_expression(part['condition'], declared)}:")
        elif part["else"]:
            lines.append("    " * depth + "else:")
        elif part["over"]:
            by = f", int({_expression(part['by'], declared)})" if part["by"] else ", 1"
            first, last = (_expression(part[k], declared) for k in ("first", "last"))
            over = f"self.{part['over'].lower()}"
            lines.append("    " * depth + f"for {over} in through({first}, {last}{by}):")
        elif part["return"]:
            lines.append("    " * depth + "return")
        elif part["call"]:
            given = re.split(r",\s*(?=\w+\s*:=)", part["given"])
            words = ", ".join(
                f"{k.strip().lower()}={_expression(v, declared)}" for k, v in (g.split(":=") for g in given)
            )
            lines.append("    " * depth + f"self.{part['call'].lower()}({words})")
        elif part["place"]:
            place = _expression(part["place"], declared)
            lines.append("    " * depth + f"{place} = {_expression(part['value'], declared)}")
        if part["if"] or part["else"] or part["over"]:
            depth += 1
        body = body[found.end() :]

    def through(first, last, by):
        return [Whole(i) for i in range(int(first), int(last) + (1 if by > 0 else -1), by)]

    space = {"F": functions, "Whole": Whole, "through": through}
    exec("\n".join(lines), space)

    def begin(self):
        for one, (kind, start) in declared.items():
            object.__setattr__(self, one, _value(kind, start, types, made))

    def put(self, one, value):
        old = getattr(self, one)
        assert type(value) is type(old), f"{name}: {one} = {value!r}"
        if type(value) is Whole:
            assert abs(value) < 1 << RANGES[declared[one][0]]
        object.__setattr__(self, one, _Array(value) if type(value) is _Array else value)

    def call(self, **given):
        for one, value in given.items():
            setattr(self, one, value)
        self.body()

    return type(name, (), {"__init__": begin, "__setattr__": put, "__call__": call, "body": space["body"]})
