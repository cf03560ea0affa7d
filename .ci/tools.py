"""What is installed under which licence (`bill`), and what is known against it (`audit`).

The tools live in an environment of their own, made from tools.txt with its hashes and kept in the user's cache.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from diffdrive_mpc.models.compiled.cache import user_folder

_LIST = Path(__file__).with_name("tools.txt")
_KNOWN_BAD = "jinja2==2.4.1"
"""Vulnerable by every data base there is: who finds nothing against it has not looked."""
_COPYLEFT = {"GPL or LGPL": ("GPL", "General Public License"), "MPL": ("MPL", "Mozilla")}


def main() -> None:
    """Carry out `bill PYTHON OUT` or `audit REQUIREMENTS...`."""
    command, *words = sys.argv[1:]
    if command == "bill":
        bill(words[0], Path(words[1]))
    elif command == "audit":
        audit(words)
    else:
        sys.exit(f"unknown command '{command}': give bill or audit")


def bill(python: str, out: Path) -> None:
    """Write what is installed beside an interpreter as CycloneDX, and say whose licence asks for something."""
    out.parent.mkdir(parents=True, exist_ok=True)
    subprocess.run(
        [tool("cyclonedx-py"), "environment", python, "--output-format", "JSON", "--output-file", str(out)], check=True
    )
    components = json.loads(out.read_text(encoding="utf-8"))["components"]
    licences = {
        one["name"]: " ".join(str(licence.get("license", licence)) for licence in one.get("licenses", ()))
        for one in components
    }
    print(f"{out}: {len(components)} components")
    for kind, words in _COPYLEFT.items():
        names = [name for name, text in licences.items() if any(word in text for word in words)]
        print(f"  {kind}: {', '.join(sorted(names)) or 'none'}")
    print(f"  no licence stated in the package: {sum(not text for text in licences.values())}, nearly all of ROS")


def audit(lists: list[str]) -> None:
    """Ask for known vulnerabilities of what the lists pin; exits with 1 where there are some.

    Where nobody could be asked it says so, and does not fail: that a service is down is no fault of what is tested.
    """
    with tempfile.TemporaryDirectory() as folder:
        probe = Path(folder) / "probe.txt"
        probe.write_text(f"{_KNOWN_BAD}\n", encoding="utf-8")
        found, reason = _asked(str(probe), "--no-deps")
    if not any(one.get("vulns") for one in found):
        print(f"NOT AUDITED: nothing is said against {_KNOWN_BAD}, which has known vulnerabilities ({reason})")
        print("  elsewhere: make audit; or give the bill of materials (make bill) to a scanner")
        return
    bad, unknown, count = list[str](), list[str](), 0
    for name in lists:
        found, reason = _asked(name)
        if not found:
            print(f"NOT AUDITED: {name} ({reason})")
        count += sum("vulns" in one for one in found)
        bad += [
            f"{one['name']} {one['version']}: {', '.join(v['id'] for v in one['vulns'])}"
            for one in found
            if one.get("vulns")
        ]
        unknown += [one["name"] for one in found if "vulns" not in one]
    print(f"audited: {count} packages; not known to the service: {', '.join(sorted(set(unknown))) or 'none'}")
    if bad:
        sys.exit("known vulnerabilities:\n  " + "\n  ".join(sorted(set(bad))))


def _asked(requirements: str, *more: str) -> tuple[list[dict[str, object]], str]:
    """What pip-audit says of each package of a list, and why where it says nothing."""
    words = ["--requirement", requirements, "--disable-pip", *more]
    words += ["--format", "json", "--progress-spinner", "off", "--timeout", "15"]
    done = subprocess.run([tool("pip-audit"), *words], capture_output=True, text=True, check=False)
    try:
        return list(json.loads(done.stdout)["dependencies"]), "the service that was asked does not know it"
    except (ValueError, KeyError):
        said = done.stderr.strip().splitlines()
        return [], said[-1][:200] if said else f"exit code {done.returncode}"


def tool(name: str) -> str:
    """Path of a tool; its environment is made where it is not there."""
    digest = hashlib.sha256(_LIST.read_bytes() + sys.version.encode()).hexdigest()[:16]
    folder = user_folder() / "tools" / digest
    if not (folder / ".ready").is_file():
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(folder)], check=True)
        pip = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, "--no-deps", "--require-hashes", "--requirement", str(_LIST)], check=True)
        (folder / ".ready").touch()
    return str(folder / "bin" / name)


if __name__ == "__main__":
    main()
