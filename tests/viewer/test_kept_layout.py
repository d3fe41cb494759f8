"""How the page is arranged is kept for the next asset."""

import pytest

from fluidlift.viewer import kept_layout
from fluidlift.viewer.kept_layout import PageLayout


@pytest.fixture(autouse=True)
def settings(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    return tmp_path / "settings"


def test_what_was_kept_comes_back():
    assert kept_layout.read() == PageLayout("small", False)
    kept_layout.keep(PageLayout("large", True))
    assert kept_layout.read() == PageLayout("large", True)


@pytest.mark.parametrize("text", ["", "[]", "[" * 4000, '{"film": 3, "folded": "yes"}', '{"film": "huge"}', "\xff"])
def test_a_damaged_file_is_as_none(settings, text):
    kept_layout.keep(PageLayout("large", True))
    kept_layout.place().write_text(text)
    assert kept_layout.read() == PageLayout()


def test_where_nothing_can_be_written_the_page_goes_on(settings):
    settings.write_text("no folder")
    kept_layout.keep(PageLayout("large", True))
    assert kept_layout.read() == PageLayout()
