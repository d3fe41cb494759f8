"""The report is one self-contained page that says what was found and warns first."""

import base64
import io
import re
from html.parser import HTMLParser

import av
import numpy as np
import pytest

from fluidlift.look.report import Figure, Section, png_bytes, report_html

PICTURE = np.random.default_rng(0).integers(0, 256, (7, 11, 3)).astype(np.uint8)


def page(**changes):
    parts = {
        "title": "river.mp4 as a fluid asset",
        "subtitle": "kind: stream",
        "sections": [
            Section(
                "Body", [Figure(PICTURE, "front depth")], [["grid", 64], ["scale", 1.23456789]], ["what", "value"],
                ["a note"],
            )
        ],
        "warnings": (),
        "links": {"preview": "preview.mp4"},
    } | changes  # fmt: skip
    return report_html(
        parts["title"], parts["subtitle"], parts["sections"], warnings=parts["warnings"], links=parts["links"]
    )


class Collector(HTMLParser):
    """Addresses, tags and text of a page."""

    def __init__(self, text):
        super().__init__()
        self.sources, self.links, self.tags, self.text = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        values = dict(attributes)
        if "src" in values:
            self.sources.append(values["src"])
        if "href" in values:
            self.links.append(values["href"])

    def handle_data(self, data):
        self.text.append(data)


def test_every_picture_says_what_good_looks_like_and_the_page_knows_the_dark():
    text = page(sections=[Section("Body", [Figure(PICTURE, "Front depth", "a smooth slope & no holes")])])
    assert "Good: a smooth slope &amp; no holes." in text
    assert "prefers-color-scheme:dark" in text


def test_the_film_is_inside_the_page():
    whole = report_html("t", "s", [], warnings=(), links={}, film=b"\x00\x01film")
    sources = Collector(whole).sources
    assert sources == ["data:video/mp4;base64," + base64.b64encode(b"\x00\x01film").decode()]
    assert "<video" not in page()


def test_nothing_is_loaded_from_elsewhere():
    found = Collector(page())
    assert found.sources and all(s.startswith("data:image/png;base64,") for s in found.sources)
    assert found.links == ["preview.mp4"]
    assert not {"script", "link", "iframe"} & set(found.tags)
    assert "url(" not in page() and "http" not in page()


def test_the_page_says_what_it_was_told():
    text = " ".join(Collector(page()).text)
    for part in (
        "river.mp4 as a fluid asset",
        "kind: stream",
        "Body",
        "front depth",
        "grid",
        "64",
        "a note",
        "preview",
    ):
        assert part in text
    assert "1.235" in text and "1.23456789" not in text  # four digits are enough for people


def test_warnings_come_before_everything_else():
    text = page(warnings=["the size is unknown"])
    assert text.index("the size is unknown") < text.index("<h2>")
    assert "No warnings" not in text
    assert "No warnings" in page()


def test_names_of_files_cannot_inject_markup():
    evil = "<script>alert('x')</script>\"&.mp4"
    text = page(
        title=evil, subtitle=evil, warnings=[evil], links={evil: evil},
        sections=[Section(evil, [Figure(PICTURE, evil)], [[evil]], [evil], [evil])],
    )  # fmt: skip
    found = Collector(text)
    assert "script" not in found.tags
    assert sum(evil in t for t in found.text) >= 7


def test_a_picture_is_the_same_when_it_is_decoded():
    data = re.search(r"base64,([^']+)'", page()).group(1)
    with av.open(io.BytesIO(base64.b64decode(data))) as container:
        decoded = next(container.decode(video=0)).to_ndarray(format="rgb24")
    np.testing.assert_array_equal(decoded, PICTURE)


@pytest.mark.parametrize("picture", [PICTURE[:, ::2], PICTURE[::-1]])
def test_pictures_need_not_be_contiguous(picture):
    assert png_bytes(picture).startswith(b"\x89PNG")


def test_lists_and_odd_values_in_tables_are_text():
    text = " ".join(Collector(page(sections=[Section("x", rows=[[[1.0, 2.5], None, True, float("nan")]])])).text)
    assert "1, 2.5" in text and "None" in text and "nan" in text


def test_commands_are_shown_as_they_are_typed_and_wide_pictures_over_the_whole_width():
    section = Section(
        "Next", [Figure(np.zeros((4, 16, 3), np.uint8), "two"), Figure(np.zeros((8, 8, 3), np.uint8), "one")],
        commands=[("fluidlift view 'a b.fluid'", "look <around>"), ("fluidlift sim", "longer")],
    )  # fmt: skip
    page = report_html("t", "s", [section], warnings=[], links={})
    assert "<pre>fluidlift view &#x27;a b.fluid&#x27;   # look &lt;around&gt;\nfluidlift sim                " in page
    assert page.count("<figure class=wide>") == 1 and page.count("<figure>") == 1
