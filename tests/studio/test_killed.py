"""The studio killed in the middle of a make, and started again: what was said and what was done is there."""

import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.request

import pytest

pytest.importorskip("starlette", reason="starlette is not installed: pip install 'fluidlift[studio]'")
pytest.importorskip("uvicorn", reason="uvicorn is not installed: pip install 'fluidlift[studio]'")

import json

from fluidlift.io.hints_file import read_hints

PATIENCE = 240.0
"""s, some ten times what the longest step takes on a machine that does nothing else"""


class Studio:
    """`fluidlift studio` in a process of its own, and what its page would ask."""

    def __init__(self, folder):
        command = [sys.executable, "-m", "fluidlift", "studio", str(folder), "--no-browser", "--port", "18460"]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )  # fmt: skip
        said = ""
        while "http://" not in said:
            said = self.process.stdout.readline()
            assert said, f"the studio ended: {self.process.wait()}"
        self.address = next(word for word in said.split() if word.startswith("http://"))
        self.origin = "/".join(self.address.split("/")[:3])
        end = time.monotonic() + PATIENCE
        while not self._answers():
            assert time.monotonic() < end, "the page is not served"
            time.sleep(0.05)

    def _answers(self):
        try:
            return bool(self.ask("state"))
        except OSError:
            return False

    def ask(self, path, data=None):
        body = None if data is None else json.dumps(data).encode()
        headers = {"Origin": self.origin, "Content-Type": "application/json"}
        with urllib.request.urlopen(urllib.request.Request(self.address + path, body, headers)) as answer:
            return json.load(answer)

    def until(self, condition, what):
        end = time.monotonic() + PATIENCE
        while not condition(state := self.ask("state")):
            assert time.monotonic() < end, f"{what} did not happen: {state['make']}, {state['error']}"
            time.sleep(0.1)
        return state

    def kill(self):
        self.process.kill()
        self.process.wait()


def ended(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    with open(f"/proc/{pid}/stat") as file:
        return file.read().rsplit(")", 1)[1].split()[0] == "Z"


@pytest.mark.skipif(not hasattr(os, "killpg") or not os.path.isdir("/proc"), reason="needs the processes of Linux")
def test_a_studio_killed_in_the_middle_of_a_make_loses_nothing(stream_clip, tmp_path):
    shutil.copy(stream_clip, tmp_path / "stream.mp4")
    first = Studio(tmp_path)
    try:
        first.ask("do/open", {"name": "stream.mp4"})
        first.until(lambda s: s["hints"] is not None, "the clip")
        first.ask("do/change", {"set": "kind", "to": "fall"})
        first.ask("do/make", {"preset": "draft"})
        state = first.until(lambda s: len(s["make"]["finished"]) >= 2, "two stages")
        maker = subprocess.run(["pgrep", "-P", str(first.process.pid)], capture_output=True, text=True).stdout.split()
    finally:
        first.kill()
    done = [stage["name"] for stage in state["make"]["finished"]]
    assert read_hints(tmp_path / "stream.hints.yaml").kind == "fall"
    second = Studio(tmp_path)
    try:
        second.ask("do/open", {"name": "stream.mp4"})
        state = second.until(lambda s: s["hints"] is not None, "the clip")
        assert state["hints"]["kind"] == "fall" and state["undo"] and not state["make"]["running"]
        # the make that the first one began ends by itself: nobody listens any more
        for pid in map(int, maker):
            end = time.monotonic() + PATIENCE
            while not ended(pid):
                assert time.monotonic() < end, "a make outlives the studio that began it"
                time.sleep(0.1)
        second.ask("do/make", {"preset": "draft"})
        state = second.until(lambda s: len(s["make"]["finished"]) >= len(done), "the stages that were done")
        kept = [stage["name"] for stage in state["make"]["finished"] if stage["kept"]]
        assert kept[: len(done)] == done, state["make"]
        second.ask("do/stop", {})
        second.until(lambda s: not s["make"]["running"], "the stop")
    finally:
        second.process.send_signal(signal.SIGINT)
        second.process.wait(30)
