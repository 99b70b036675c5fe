"""All files that the documents name exist."""

import re
from pathlib import Path

import hoidata

ROOT = Path(__file__).parents[1]


def test_all_files_in_the_guide_for_newcomers_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").split("## Where is it?")[1].split("\n## ")[0]
    answers = re.findall(r"^\| .+\? \| (.+) \|$", text, re.MULTILINE)
    assert len(answers) >= 12
    missing = [name for answer in answers for name in re.findall(r"`(.+?)`", answer) if not (ROOT / name).is_file()]
    assert missing == []


def test_the_table_of_packages_lists_exactly_the_packages():
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").split("| package |")[1].split("\n\n")[0]
    named = {
        package
        for line in text.splitlines()[2:]
        for package in re.findall(r"`(\w+)`", line.replace("\\|", "/").split("|")[1])
    }
    folders = {path.parent.name for path in Path(hoidata.__path__[0]).glob("*/__init__.py")}
    modules = {path.stem for path in Path(hoidata.__path__[0]).glob("*.py")} - {"__init__"}
    assert named == folders | modules
