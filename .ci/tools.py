"""Licences of the installed packages (`bill`), and their known vulnerabilities (`audit`).

The tools are installed in a separate environment in the user's cache, from tools.txt with hashes.
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
"""Package with vulnerabilities in every database; an audit that reports none has failed."""
_COPYLEFT = {"GPL or LGPL": ("GPL", "General Public License"), "MPL": ("MPL", "Mozilla")}


def main() -> None:
    """Run `bill PYTHON OUT` or `audit REQUIREMENTS...`."""
    command, *words = sys.argv[1:]
    if command == "bill":
        bill(words[0], Path(words[1]))
    elif command == "audit":
        audit(words)
    else:
        sys.exit(f"unknown command '{command}': give bill or audit")


def bill(python: str, out: Path) -> None:
    """Write the installed packages of an interpreter as CycloneDX, and print packages with copyleft licences."""
    out.parent.mkdir(parents=True, exist_ok=True)
    subprocess.run(
        [tool("cyclonedx-py"), "environment", python, "--output-format", "JSON", "--output-file", str(out)], check=True
    )
    components = json.loads(out.read_text(encoding="utf-8"))["components"]
    licences = {
        component["name"]: " ".join(str(licence.get("license", licence)) for licence in component.get("licenses", ()))
        for component in components
    }
    print(f"{out}: {len(components)} components")
    for kind, words in _COPYLEFT.items():
        names = [name for name, text in licences.items() if any(word in text for word in words)]
        print(f"  {kind}: {', '.join(sorted(names)) or 'none'}")
    print(f"  no licence stated in the package: {sum(not text for text in licences.values())}, nearly all of ROS")


def audit(lists: list[str]) -> None:
    """Audit the packages that the lists pin; exit with 1 if there are vulnerabilities.

    If the service cannot be reached, print a note and do not fail: an outage is no fault of the packages.
    """
    with tempfile.TemporaryDirectory() as folder:
        probe = Path(folder) / "probe.txt"
        probe.write_text(f"{_KNOWN_BAD}\n", encoding="utf-8")
        packages, reason = _pip_audit(str(probe), "--no-deps")
    if not any(package.get("vulns") for package in packages):
        print(f"NOT AUDITED: the service reports nothing for {_KNOWN_BAD}, which has known vulnerabilities ({reason})")
        print("  run `make audit` on another machine, or pass the bill of materials (make bill) to a scanner")
        return
    bad, unknown, count = list[str](), list[str](), 0
    for name in lists:
        packages, reason = _pip_audit(name)
        if not packages:
            print(f"NOT AUDITED: {name} ({reason})")
        count += sum("vulns" in package for package in packages)
        bad += [
            f"{package['name']} {package['version']}: {', '.join(v['id'] for v in package['vulns'])}"
            for package in packages
            if package.get("vulns")
        ]
        unknown += [package["name"] for package in packages if "vulns" not in package]
    print(f"audited: {count} packages; not known to the service: {', '.join(sorted(set(unknown))) or 'none'}")
    if bad:
        sys.exit("known vulnerabilities:\n  " + "\n  ".join(sorted(set(bad))))


def _pip_audit(requirements: str, *more: str) -> tuple[list[dict[str, object]], str]:
    """Return pip-audit's result for each package of a list, or the reason for its failure."""
    words = ["--requirement", requirements, "--disable-pip", *more]
    words += ["--format", "json", "--progress-spinner", "off", "--timeout", "15"]
    done = subprocess.run([tool("pip-audit"), *words], capture_output=True, text=True, check=False)
    try:
        return list(json.loads(done.stdout)["dependencies"]), "the service does not know the package"
    except (ValueError, KeyError):
        errors = done.stderr.strip().splitlines()
        return [], errors[-1][:200] if errors else f"exit code {done.returncode}"


def tool(name: str) -> str:
    """Return the path of a tool; create its environment if it is missing."""
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
