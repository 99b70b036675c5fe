"""A reader finds what the documents name: every file they point to is there."""

import re
from pathlib import Path

import hoidata

ROOT = Path(__file__).parents[1]


def test_every_question_of_a_newcomer_is_answered_by_files_that_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").split("## Where is it?")[1].split("\n## ")[0]
    answers = re.findall(r"^\| .+\? \| (.+) \|$", text, re.MULTILINE)
    assert len(answers) >= 12
    missing = [name for answer in answers for name in re.findall(r"`(.+?)`", answer) if not (ROOT / name).is_file()]
    assert missing == []


def test_the_table_of_packages_names_every_package_and_no_other():
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").split("| package |")[1].split("\n\n")[0]
    named = {
        room for row in text.splitlines()[2:] for room in re.findall(r"`(\w+)`", row.replace("\\|", "/").split("|")[1])
    }
    folders = {path.parent.name for path in Path(hoidata.__path__[0]).glob("*/__init__.py")}
    modules = {path.stem for path in Path(hoidata.__path__[0]).glob("*.py")} - {"__init__"}
    assert named == folders | modules
