"""The plan of `make mutants` names existing files and tests."""

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
    core_files = {
        f"{folder}/{path.name}"
        for folder in FOLDERS
        for path in (mutants.ROOT / folder).iterdir()
        if path.suffix in (".c", ".py") and path.name != "__init__.py"
    }
    assert sorted(files) == sorted(core_files)
    tests = [name for group in mutants.PLAN["groups"] for stage in group["tests"] for name in stage.split()]
    assert [name for name in tests if not (mutants.ROOT / name.partition("::")[0]).exists()] == []


def test_explained_mutant_can_be_drawn():
    for entry in mutants.PLAN["explained"]:
        text = (mutants.ROOT / entry["file"]).read_text(encoding="utf-8")
        assert entry["before"] in [line.strip() for line in text.splitlines()], entry
        assert entry["reason"]
