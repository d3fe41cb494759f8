"""The page of results is what its command writes, and comparisons say what got better or worse."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SPEC = importlib.util.spec_from_file_location("report", ROOT / "benchmarks" / "report.py")
report = importlib.util.module_from_spec(SPEC)
sys.modules["report"] = report  # dataclasses look their module up
SPEC.loader.exec_module(report)

TOPIC = {
    "title": "T", "text": "Words.", "rows": "subject", "command": "run", "date": "2026-01-01", "machine": "m",
    "figures": {"error": {"unit": "px", "better": "less", "goal": 0.5}, "count": {"unit": "", "better": ""}},
    "records": [
        {"subject": "a", "figure": "error", "value": 0.4},
        {"subject": "b", "figure": "error", "value": 0.6, "before": 0.7},
        {"subject": "b", "figure": "count", "value": 3},
    ],
}  # fmt: skip


def with_values(**values: float) -> list:
    """The topic's records, errors replaced by subject."""
    records = [r | {"value": values.get(r["subject"], r["value"])} for r in TOPIC["records"] if r["figure"] == "error"]
    return report.records_of("t", TOPIC | {"records": records})


def test_the_page_is_what_the_command_writes_and_short():
    text = report.PAGE.read_text(encoding="utf-8")
    assert text == report.page(), "run python -m benchmarks.report"
    assert text.count("\n") <= report.LONGEST


def test_every_record_says_by_what_command_when_and_on_what_machine():
    records = [r for topic, content in report.topics().items() for r in report.records_of(topic, content)]
    assert len(records) > 500
    assert [r for r in records if not (r.command and r.date and r.machine)] == []
    keys = [(r.topic, r.subject, r.figure) for r in records]
    assert sorted({k for k in keys if keys.count(k) > 1}) == []


def test_goals_that_are_missed_are_bold_and_the_value_before_is_in_brackets():
    lines = report.section(TOPIC, report.records_of("t", TOPIC))
    assert "| subject | error, px, goal ≤ 0.5 | count |" in lines
    assert "| a | 0.4 |  |" in lines and "| b | **0.6** (0.7) | 3 |" in lines


def test_a_comparison_knows_which_direction_is_better():
    found = report.compared(with_values(a=0.45, b=0.55), with_values(a=0.6, b=0.4))
    assert found["better"] == ["t: a, error: 0.6 > 0.45 px"]
    assert found["worse"] == ["t: b, error: 0.4 > 0.55 px, now misses its goal"]
    assert found["new"] == found["gone"] == found["changed"] == []


def test_what_is_new_and_what_is_gone_is_listed():
    both = with_values()
    found = report.compared(both[:1], both[1:])
    assert found["new"] == ["t: a, error: 0.4 px"] and found["gone"] == ["t: b, error"]


def test_figures_that_are_put_replace_those_of_the_same_subject_and_keep_what_was_before(tmp_path):
    (tmp_path / "t.json").write_text(report.text_of(TOPIC), encoding="utf-8")
    new = [
        {"subject": "a", "figure": "error", "value": 0.3},
        {"subject": "c", "figure": "speed", "value": 1.0, "unit": "m/s"},
    ]
    report.put("t", new, folder=tmp_path, date="2026-02-02")
    content = json.loads((tmp_path / "t.json").read_text(encoding="utf-8"))
    records = {(r.subject, r.figure): r for r in report.records_of("t", content)}
    assert (records["a", "error"].value, records["a", "error"].before, records["a", "error"].date) == (
        0.3,
        0.4,
        "2026-02-02",
    )
    assert records["b", "error"].date == "2026-01-01"
    assert not records["c", "speed"].shown and records["c", "speed"].unit == "m/s"


@pytest.mark.parametrize("wrong", [{"figure": "unknown"}, {"better": "higher"}])
def test_a_record_that_makes_no_sense_is_refused(wrong):
    content = TOPIC | {"records": [TOPIC["records"][0] | wrong]}
    with pytest.raises(ValueError):
        report.records_of("t", content)
