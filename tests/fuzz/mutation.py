"""Edits of bytes and of trees of values, as JSON values, so that Hypothesis can reduce a case edit by edit."""

from __future__ import annotations

import copy
from random import Random
from typing import Any

from fuzz import odd

Edit = list[Any]
TREE_EDITS = (*3 * ("number",), *2 * ("scale",), "word", "type", "remove", "rename", "double", "nest", "copy", "null")
TREE_EDITS += ("longer", "swap")


def draw_tree_edit(random: Random) -> Edit:
    """Draw an edit of a tree of values; positions are numbers modulo the number of entries."""
    kind = random.choice(TREE_EDITS)
    position, source = random.randrange(10**6), random.randrange(10**6)
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
    return [kind, position, source, argument]


def edited_tree(tree: Any, edits: list[Edit]) -> Any:
    """Return the tree after all edits."""
    tree = copy.deepcopy(tree)
    for edit in edits:
        tree = _apply_edit(tree, *edit)
    return tree


def _apply_edit(tree: Any, kind: str, position: int, source: int, argument: Any) -> Any:
    entries = list(_entries(tree))
    if not entries:
        return argument
    if kind in ("number", "scale"):
        numbers = [(container, key) for container, key in entries if _is_number(container[key])]
        entries = numbers or entries
    container, key = entries[position % len(entries)]
    source_container, source_key = entries[source % len(entries)]
    value = container[key]
    if kind in ("number", "word", "type"):
        container[key] = copy.deepcopy(argument)
    elif kind == "scale":
        container[key] = value * argument if _is_number(value) else argument
    elif kind == "remove":
        del container[key]
    elif kind == "rename" and isinstance(container, dict):
        container[f"{key}x"] = container.pop(key)
    elif kind == "double" and isinstance(container, list):
        container.insert(key, copy.deepcopy(value))
    elif kind == "nest":
        for _ in range(argument):
            value = [value]
        container[key] = value
    elif kind == "copy":
        container[key] = copy.deepcopy(source_container[source_key])
    elif kind == "swap":
        container[key], source_container[source_key] = copy.deepcopy(source_container[source_key]), copy.deepcopy(value)
    elif kind == "longer" and isinstance(value, list | str):
        container[key] = value * argument
    else:
        container[key] = None
    return tree


def _entries(tree: Any) -> Any:
    items = enumerate(tree) if isinstance(tree, list) else tree.items() if isinstance(tree, dict) else ()
    for key, value in list(items):
        yield tree, key
        yield from _entries(value)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


_TOKENS = (
    *(b"{", b"[", b"]", b"}", b": ", b"- ", b"&a ", b"*a", b"!!int ", b"!!bool z", b"!!python/object:os.system x"),
    *(b"\t", b"'", b'"', b"#", b"|", b"%", b"@", b"\r", b"\x00", b"\xff", b"\xef\xbb\xbf", b"---\n", b"? ", b"<<: *a"),
    *(b".nan", b".inf", b"1e400", b"0o7", b"2020-13-40", b"~", b"99999999999999999999", b"nan", b"inf"),
    *(b"\xe2\x80\xae", b"\x1b[2J", b",", b";", b"-", b"\n", b" "),
)


def draw_bytes_edit(random: Random) -> Edit:
    """Draw an edit of bytes; positions are shares of the length."""
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
    """Return the bytes after all edits."""
    data = bytearray(content)
    for kind, share, argument in edits:
        position = int(share * len(data))
        if kind == "flip" and data:
            data[position] = argument
        elif kind == "token":
            data[position:position] = argument.encode("latin-1")
        elif kind == "cut":
            del data[position : position + argument]
        elif kind == "repeat":
            data[position:position] = data[position : position + argument] * 20
        elif kind == "end":
            del data[position:]
        elif kind == "length":
            data[position : position + 4] = int(argument).to_bytes(4, "little")
        elif kind == "line":
            lines = data.split(b"\n")
            line = lines.pop(int(share * len(lines)))
            lines.insert(argument * len(lines) // 100, line)
            data = bytearray(b"\n".join(lines))
        elif kind == "cell":
            start = max(data.rfind(b",", 0, position), data.rfind(b"\n", 0, position)) + 1
            ends = [end for end in (data.find(b",", position), data.find(b"\n", position)) if end >= 0]
            data[start : min(ends, default=len(data))] = argument.encode("utf-8", "surrogatepass")
    return bytes(data)
