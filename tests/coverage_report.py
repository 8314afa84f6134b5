"""`make coverage`: runs the tests and writes docs/coverage.md, what each numbered item's test required and what it measured.

    python tests/coverage_report.py          # the default tests; results of slow ones are those stored
    python tests/coverage_report.py --slow   # the slow tests; stores their results with commit, command and date
    python tests/coverage_report.py --slow -k trpo   # some of them; the others' stored results stay

The checks come from the tests themselves (the fixture `item`), in the run that this script makes; nothing is written by hand.
"""

import csv
import datetime
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
STORED = ROOT / "tests" / "slow_results.json"
PAGE = ROOT / "docs" / "coverage.md"
SHOWN = 6
"""Checks of one item that the table shows; the rest are counted."""


def run(slow: bool, more: list[str]) -> tuple[list[dict], int]:
    """Run the tests; every recorded check, and pytest's exit status."""
    with tempfile.TemporaryDirectory() as folder:
        marker = "slow" if slow else "not slow"
        command = [sys.executable, "-m", "pytest", "-q", "-m", marker, *(() if slow else ("-n", "2")), *more]
        # Slow tests compute much: there the compiler may optimise, which default tests forbid it.
        flags = {"XLA_FLAGS": os.environ.get("XLA_FLAGS", "")} if slow else {}
        status = subprocess.run(command, cwd=ROOT, env={**os.environ, **flags, "RTG_COVERAGE": folder}).returncode
        rows = [
            json.loads(line) for file in sorted(Path(folder).glob("*.jsonl")) for line in file.read_text().splitlines()
        ]
    return rows, status


def store(rows: list[dict]) -> list[dict]:
    """Keep the results of slow tests, with where they come from."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True
    ).stdout.strip()
    about = {"commit": commit, "date": datetime.date.today().isoformat(), "command": "make slow"}
    old = json.loads(STORED.read_text()) if STORED.exists() else []
    tests = {row["test"] for row in rows}
    kept = [row for row in old if row["test"] not in tests] + [{**row, **about} for row in rows]
    STORED.write_text(json.dumps(kept, indent=1) + "\n")
    return kept


def cell(row: dict) -> str:
    """One check: what was measured and required, and for a slow one when."""
    what = f"{row['what']}: " if row["what"] else ""
    when = f" (slow, {row['date']}, {row['commit']})" if "date" in row else ""
    mark = "" if row["passed"] else " **failed**"
    return f"{what}{row['value']:.4g} {row['comparison'].replace('<', '&lt;').replace('>', '&gt;')} {row['bound']:g}{mark}{when}"


def write(rows: list[dict]) -> None:
    """Write the page."""
    found: dict[str, list[dict]] = defaultdict(list)
    for row in rows:
        found[row["item"]].append(row)
    with (ROOT / "tests" / "items.csv").open(newline="") as file:
        items = list(csv.DictReader(file))
    unknown = sorted(set(found) - {item["item"] for item in items})
    if unknown:
        raise SystemExit(f"tests record items that tests/items.csv does not have: {', '.join(unknown)}")
    chapters: dict[str, list[dict]] = defaultdict(list)
    for item in items:
        chapters[item["chapter"]].append(item)
    good = {name for name, checks in found.items() if all(check["passed"] for check in checks)}
    lines = ["# Coverage", "",
             "Every numbered formula, algorithm, figure and caveat of the notes, what its test requires and what it measured. "
             "Written by `make coverage` from the run of the tests itself; results of slow tests are stored with commit and date.", "",
             f"**{len(good)} of {len(items)} items pass their tests.** The others are not written yet.", "",
             "| chapter | passed | of |", "|---|---:|---:|"]  # fmt: skip
    lines += [
        f"| {chapter} | {sum(i['item'] in good for i in members)} | {len(members)} |"
        for chapter, members in chapters.items()
    ]
    for chapter, members in chapters.items():
        lines += ["", f"## {chapter}", "", "| item | what | measured and required |", "|---|---|---|"]
        for item in members:
            checks = found.get(item["item"], [])
            text = "<br>".join(cell(check) for check in checks[:SHOWN])
            text += f"<br>and {len(checks) - SHOWN} more" if len(checks) > SHOWN else ""
            mark = f" ({item['mark']})" if item["mark"] else ""
            name = item["name"].replace("|", "\\|").replace("*", "\\*").replace("<", "&lt;")
            lines.append(f"| {item['item']} | {name}{mark} | {text} |")
    PAGE.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"{len(good)} of {len(items)} items pass; see {PAGE.relative_to(ROOT)}")


def main() -> int:
    """Run, store, write; pytest's exit status."""
    slow = "--slow" in sys.argv[1:]
    rows, status = run(slow, [word for word in sys.argv[1:] if word != "--slow"])
    if slow:
        store(rows)
        return status
    if not rows:
        print("no test recorded anything: the page stays as it was", file=sys.stderr)
        return status or 1
    write(rows + (json.loads(STORED.read_text()) if STORED.exists() else []))
    return status


if __name__ == "__main__":
    sys.exit(main())
