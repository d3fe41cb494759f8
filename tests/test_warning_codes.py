"""Every warning has a code that stays what it is, and docs/warnings.md lists them all with their texts.

`python tests/test_warning_codes.py` writes the list anew.
"""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs/warnings.md"
HEAD = """# Warnings

Every warning has a code, by which programs tell it from others: texts may become better, codes stay.
`manifest.json`, `motion.json` and what commands print with `--json` hold `warning_codes` beside `warnings`, one for
each, in the same order. [Troubleshooting](troubleshooting.md) says what to do. `…` stands for what differs.

| code | text |
|---|---|
"""
PASSED_ON = ("messages.py", "stage_codec.py")
"""modules that give warnings back the codes that they had"""
ELSEWHERE = {
    "e.note": "…: … closed at the sides and below (what was done to close the mesh that replaces the terrain)",
    "done.failed": "the simulation broke down: the frames before are kept (the text says where and why)",
    "told": "…: obstacle '…' at (…) m begins … m inside the ground…",
}
"""texts that are put together somewhere else, by the expression that holds them"""


@functools.cache
def notices() -> list[tuple[str, str]]:
    """Code and text of every warning in the source, as far as both are written there."""
    found = []
    for file in sorted((ROOT / "src/fluidlift").rglob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        names = {
            t.id: node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Assign)
            for t in node.targets
            if isinstance(t, ast.Name)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Notice":
                code, text = (names.get(a.id, a) if isinstance(a, ast.Name) else a for a in node.args)
                if isinstance(code, ast.Constant) and code.value:
                    found.append((str(code.value), text_of(text)))
                else:
                    assert file.name in PASSED_ON, f"{file}:{node.lineno}: a code that is not written there"
    return found


def text_of(node: ast.expr) -> str:
    """What a text says, with … for its expressions."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part) for part in node.values)
    if isinstance(node, ast.FormattedValue):
        return "…"
    return ELSEWHERE.get(ast.unparse(node), "…")


def page() -> str:
    """The list as it should be: a line for each code and text."""
    rows = sorted({(code, " ".join(text.split()).replace("|", "\\|")) for code, text in notices()})
    return HEAD + "".join(f"| `{code}` | {text} |\n" for code, text in rows)


def test_codes_are_lower_case_words_with_hyphens():
    assert len(notices()) > 60
    assert [code for code, _ in notices() if not re.fullmatch(r"[a-z]+(-[a-z]+)*", code)] == []


def test_the_list_of_warnings_is_that_of_the_source():
    assert PAGE.read_text(encoding="utf-8") == page(), f"python tests/{Path(__file__).name} writes it anew"


def test_what_warns_has_a_code_as_types_say():
    loose = [
        f"{file.name}: {line.strip()}"
        for file in sorted((ROOT / "src/fluidlift/types").glob("*.py"))
        for line in file.read_text(encoding="utf-8").splitlines()
        if re.match(r"\s+warnings?: ", line) and "Notice" not in line
    ]
    assert loose == []


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
