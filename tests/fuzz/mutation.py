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
    """Draw a change of a tree of values; places are numbers modulo the number of places."""
    kind = random.choice(TREE_EDITS)
    place, source = random.randrange(10**6), random.randrange(10**6)
    argument: Any = None
    if kind == "number":
        argument = odd.number(random) if random.random() < 0.7 else random.choice(odd.INTEGERS)
    elif kind == "scale":
        argument = random.choice((-1.0, 10.0, 0.1, 1e3, 1e-3, 1e6, 1e-6, 1.5, 0.0, random.uniform(0.0, 3.0)))
    elif kind == "word":
        argument = random.choice(odd.WORDS)
    elif kind == "type":
        argument = random.choice(([], {}, [1, 2, 3], {"x": 1}, True, None, "word", 1, 1.5, [[]], [None], {"": None}))
    elif kind == "longer":
        argument = random.choice((2, 10, 1000))
    elif kind == "nest":
        argument = random.choice((1, 5, 100))
    return [kind, place, source, argument]


def edited_tree(tree: Any, edits: list[Edit]) -> Any:
    """Return the tree after all changes."""
    tree = copy.deepcopy(tree)
    for edit in edits:
        tree = _edited(tree, *edit)
    return tree


def _edited(tree: Any, kind: str, place: int, source: int, argument: Any) -> Any:
    places = list(_places(tree))
    if not places:
        return argument
    if kind in ("number", "scale"):
        numbers = [(holder, key) for holder, key in places if _is_number(holder[key])]
        places = numbers or places
    holder, key = places[place % len(places)]
    from_holder, from_key = places[source % len(places)]
    value = holder[key]
    if kind in ("number", "word", "type"):
        holder[key] = copy.deepcopy(argument)
    elif kind == "scale":
        holder[key] = value * argument if _is_number(value) else argument
    elif kind == "remove":
        del holder[key]
    elif kind == "rename" and isinstance(holder, dict):
        holder[f"{key}x"] = holder.pop(key)
    elif kind == "double" and isinstance(holder, list):
        holder.insert(key, copy.deepcopy(value))
    elif kind == "nest":
        for _ in range(argument):
            value = [value]
        holder[key] = value
    elif kind == "copy":
        holder[key] = copy.deepcopy(from_holder[from_key])
    elif kind == "swap":
        holder[key], from_holder[from_key] = copy.deepcopy(from_holder[from_key]), copy.deepcopy(value)
    elif kind == "longer" and isinstance(value, list | str):
        holder[key] = value * argument
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
    """Draw a change of bytes; places are shares of the length."""
    kind = random.choice(("flip", "flip", "token", "token", "cut", "end", "repeat", "length", "line", "cell", "cell"))
    share = random.random()
    if kind == "flip":
        return [kind, share, random.randrange(256)]
    if kind == "token":
        return [kind, share, random.choice(_TOKENS).decode("latin-1")]
    if kind in ("cut", "repeat"):
        return [kind, share, random.choice((1, 4, 16, 100, 1000))]
    if kind == "length":
        return [kind, share, random.choice((0, 1, 255, 2**16, 2**31 - 1, 2**32 - 1, 10**6, 10**8))]
    if kind == "cell":
        return [kind, share, random.choice((repr(odd.number(random)), random.choice(odd.WORDS)))]
    return [kind, share, random.randrange(100)]


def edited_bytes(content: bytes, edits: list[Edit]) -> bytes:
    """Return the bytes after all changes."""
    data = bytearray(content)
    for kind, share, argument in edits:
        place = int(share * len(data))
        if kind == "flip" and data:
            data[place] = argument
        elif kind == "token":
            data[place:place] = argument.encode("latin-1")
        elif kind == "cut":
            del data[place : place + argument]
        elif kind == "repeat":
            data[place:place] = data[place : place + argument] * 20
        elif kind == "end":
            del data[place:]
        elif kind == "length":
            data[place : place + 4] = int(argument).to_bytes(4, "little")
        elif kind == "line":
            lines = data.split(b"\n")
            line = lines.pop(int(share * len(lines)))
            lines.insert(argument * len(lines) // 100, line)
            data = bytearray(b"\n".join(lines))
        elif kind == "cell":
            start = max(data.rfind(b",", 0, place), data.rfind(b"\n", 0, place)) + 1
            ends = [end for end in (data.find(b",", place), data.find(b"\n", place)) if end >= 0]
            data[start : min(ends, default=len(data))] = argument.encode("utf-8", "surrogatepass")
    return bytes(data)
