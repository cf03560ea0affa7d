"""The plan of `make mutants` names existing files and tests, and a mutant differs from the product in one token."""

import pytest

import mutants

FOLDERS = (
    "mpc/core",
    "mpc/problem",
    "models/structures",
    "sim/metrics",
    "packages/monitor/src/diffdrive_mpc_monitor/core",
)


def test_every_file_of_the_core_has_tests():
    files = [name for group in mutants.PLAN["groups"] for name in group["files"]]
    written = {
        f"{folder}/{path.name}"
        for folder in FOLDERS
        for path in (mutants.ROOT / folder).iterdir()
        if path.suffix in (".c", ".py") and path.name != "__init__.py"
    }
    assert sorted(files) == sorted(written)
    tests = [name for group in mutants.PLAN["groups"] for stage in group["tests"] for name in stage.split()]
    assert [name for name in tests if not (mutants.ROOT / name).exists()] == []


def test_explained_mutant_can_be_drawn():
    for entry in mutants.PLAN["explained"]:
        text = (mutants.ROOT / entry["file"]).read_text(encoding="utf-8")
        assert entry["before"] in [line.strip() for line in text.splitlines()], entry
        assert entry["reason"]


@pytest.mark.parametrize(
    ("path", "line", "after"),
    [
        ("a.c", "x = a[i] - 1.0; /* - 2 */", {"x = a[i + 1] - 1.0; /* - 2 */", "x = a[i - 1] - 1.0; /* - 2 */",
                                              "x = a[i] + 1.0; /* - 2 */", "x = a[i] - 1.1; /* - 2 */"}),
        ("a.c", "#if N > 2", set()),
        ("a.c", "p->a = q->c; p->b = *d;", {"p->b = q->c; p->b = *d;", "p->a = q->c; p->a = *d;"}),
        ("a.py", "def f(x: int = 3, *rest): return max(x, '1')  # 1", {
            "def f(x: int = 4, *rest): return max(x, '1')  # 1", "def f(x: int = 2, *rest): return max(x, '1')  # 1",
            "def f(x: int = 3, *rest): return min(x, '1')  # 1"}),
        ("a.py", "if not a <= b: pass", {"if  a <= b: pass", "if not a < b: pass", "if not a > b: pass"}),
    ],
)  # fmt: skip
def test_mutant_changes_one_token(path, line, after):
    text = f"begin = begin\n{line}\nend = end\n" if path.endswith(".py") else f"int begin;\n{line}\nint end;\n"
    drawn = [mutant for site in mutants.mutants_of(path, text) for mutant in site]
    assert {mutant.change[2] for mutant in drawn} == after
    assert all(mutant.change[:2] == (path, line) for mutant in drawn)


def test_array_size_is_no_mutant():
    text = "    real state[MOST], before[2], after = before[1] - 3;\n    x[2] = 1;\n    before[1] = a;\n"
    places = [text[m.span[0] - 1 :][:3] for site in mutants.mutants_of("a.c", text) for m in site if m.is_size]
    assert set(places) == {"[2]"} and text.index("[2]") == text.index("before[2]") + 6
