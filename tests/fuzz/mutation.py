"""Changes of texts, trees of values and bytes, as plain values, so that a case can be made smaller change by change."""

from __future__ import annotations

import copy
from random import Random
from typing import Any

from fuzz import odd

Edit = list[Any]
TREE_EDITS = (*3 * ("number",), *2 * ("scale",), "word", "type", "remove", "rename", "double", "nest", "copy", "null")
TREE_EDITS += ("longer", "swap")


def draw_tree_edit(random: Random) -> Edit:
    """A change of a tree of values; where, is a number that is taken modulo the places that there are."""
    kind = random.choice(TREE_EDITS)
    place, other = random.randrange(10**6), random.randrange(10**6)
    given: Any = None
    if kind == "number":
        given = odd.number(random) if random.random() < 0.7 else random.choice(odd.INTEGERS)
    elif kind == "scale":
        given = random.choice((-1.0, 10.0, 0.1, 1e3, 1e-3, 1e6, 1e-6, 1.5, 0.0, random.uniform(0.0, 3.0)))
    elif kind == "word":
        given = random.choice(odd.WORDS)
    elif kind == "type":
        given = random.choice(([], {}, [1, 2, 3], {"x": 1}, True, None, "word", 1, 1.5, [[]], [None], {"": None}))
    elif kind == "longer":
        given = random.choice((2, 10, 1000))
    elif kind == "nest":
        given = random.choice((1, 5, 100))
    return [kind, place, other, given]


def edited_tree(tree: Any, edits: list[Edit]) -> Any:
    """The tree after all changes."""
    tree = copy.deepcopy(tree)
    for edit in edits:
        tree = _edited(tree, *edit)
    return tree


def _edited(tree: Any, kind: str, place: int, other: int, given: Any) -> Any:
    places = list(_places(tree))
    if not places:
        return given
    if kind in ("number", "scale"):
        numbers = [(holder, key) for holder, key in places if _is_number(holder[key])]
        places = numbers or places
    holder, key = places[place % len(places)]
    from_holder, from_key = places[other % len(places)]
    value = holder[key]
    if kind in ("number", "word", "type"):
        holder[key] = copy.deepcopy(given)
    elif kind == "scale":
        holder[key] = value * given if _is_number(value) else given
    elif kind == "remove":
        del holder[key]
    elif kind == "rename" and isinstance(holder, dict):
        holder[f"{key}x"] = holder.pop(key)
    elif kind == "double" and isinstance(holder, list):
        holder.insert(key, copy.deepcopy(value))
    elif kind == "nest":
        for _ in range(given):
            value = [value]
        holder[key] = value
    elif kind == "copy":
        holder[key] = copy.deepcopy(from_holder[from_key])
    elif kind == "swap":
        holder[key], from_holder[from_key] = copy.deepcopy(from_holder[from_key]), copy.deepcopy(value)
    elif kind == "longer" and isinstance(value, list | str):
        holder[key] = value * given
    else:
        holder[key] = None
    return tree


def _places(tree: Any) -> Any:
    items = enumerate(tree) if isinstance(tree, list) else tree.items() if isinstance(tree, dict) else ()
    for key, value in list(items):
        yield tree, key
        yield from _places(value)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


_TOKENS = (
    *(b"{", b"[", b"]", b"}", b": ", b"- ", b"&a ", b"*a", b"!!int ", b"!!bool z", b"!!python/object:os.system x"),
    *(b"\t", b"'", b'"', b"#", b"|", b"%", b"@", b"\r", b"\x00", b"\xff", b"\xef\xbb\xbf", b"---\n", b"? ", b"<<: *a"),
    *(b".nan", b".inf", b"1e400", b"0o7", b"2020-13-40", b"~", b"99999999999999999999", b"nan", b"inf"),
    *(b"\xe2\x80\xae", b"\x1b[2J", b",", b";", b"-", b"\n", b" "),
)


def draw_bytes_edit(random: Random) -> Edit:
    """A change of bytes; places are shares of the length."""
    kind = random.choice(("flip", "flip", "token", "token", "cut", "end", "repeat", "length", "line", "cell", "cell"))
    at = random.random()
    if kind == "flip":
        return [kind, at, random.randrange(256)]
    if kind == "token":
        return [kind, at, random.choice(_TOKENS).decode("latin-1")]
    if kind in ("cut", "repeat"):
        return [kind, at, random.choice((1, 4, 16, 100, 1000))]
    if kind == "length":
        return [kind, at, random.choice((0, 1, 255, 2**16, 2**31 - 1, 2**32 - 1, 10**6, 10**8))]
    if kind == "cell":
        return [kind, at, random.choice((repr(odd.number(random)), random.choice(odd.WORDS)))]
    return [kind, at, random.randrange(100)]


def edited_bytes(content: bytes, edits: list[Edit]) -> bytes:
    """The bytes after all changes."""
    data = bytearray(content)
    for kind, at, given in edits:
        place = int(at * len(data))
        if kind == "flip" and data:
            data[place] = given
        elif kind == "token":
            data[place:place] = given.encode("latin-1")
        elif kind == "cut":
            del data[place : place + given]
        elif kind == "repeat":
            data[place:place] = data[place : place + given] * 20
        elif kind == "end":
            del data[place:]
        elif kind == "length":
            data[place : place + 4] = int(given).to_bytes(4, "little")
        elif kind == "line":
            lines = data.split(b"\n")
            line = lines.pop(int(at * len(lines)))
            lines.insert(given * len(lines) // 100, line)
            data = bytearray(b"\n".join(lines))
        elif kind == "cell":
            begin = max(data.rfind(b",", 0, place), data.rfind(b"\n", 0, place)) + 1
            ends = [end for end in (data.find(b",", place), data.find(b"\n", place)) if end >= 0]
            data[begin : min(ends, default=len(data))] = given.encode("utf-8", "surrogatepass")
    return bytes(data)
