"""Stages: what a name in the cell file may stand for, and what is said where it is nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.errors import LiveError
from dwell.live.stage import Message, load_actuator, load_function, load_stage

HERE = "stages_of_test_stage"
MODULE = """
import functools
from dwell.live.stage import CellStage, Message

def double(inputs):
    return Message(2)

double_again = functools.partial(double)

class Bare:
    def process(self, inputs):
        return Message(1)

class Kept(Bare):
    inputs = {"a": dict}
    def snapshot(self): return b""
    def restore(self, state): pass

class Everything:
    inputs = {"a": dict}
    def __init__(self): self.called = []
    def process(self, inputs): return Message(self.called)
    def start(self): self.called.append("start")
    def stop(self): self.called.append("stop")
    def wait(self): self.called.append("wait")
    def snapshot(self): self.called.append("snapshot")
    def restore(self, state): self.called.append("restore")

class Derived(CellStage):
    def process(self, inputs): return Message(1)
    def wait(self): pass
    def snapshot(self): return b""
    def restore(self, state): pass

made = Bare()

class Nested:
    Inner = Bare

class Needs:
    def __init__(self, camera): pass

class Fails:
    def __init__(self): raise OSError("no camera")

class Nothing: pass

class Arm:
    def apply(self, command): pass
    def hold(self): pass
    def zero(self): pass

class Half:
    def apply(self, command): pass
    def hold(self): pass

number = 3
"""


@pytest.fixture(autouse=True)
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / f"{HERE}.py").write_text(MODULE)
    (tmp_path / "stages_that_fail.py").write_text("import no_such_package_at_all\n")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize("name", ["double", "double_again", "Bare", "Kept", "made", "Nested.Inner"])
def test_what_is_a_stage(name: str) -> None:
    stage = load_stage(f"{HERE}:{name}", "tasks.a.run")
    assert isinstance(stage.process({}), Message)


def test_a_state_is_what_has_both_methods() -> None:
    assert load_stage(f"{HERE}:Kept", "x").stateful
    assert load_stage(f"{HERE}:Derived", "x").stateful
    assert not load_stage(f"{HERE}:Bare", "x").stateful


@pytest.mark.parametrize("name", ["double", "Bare", "Kept"])
def test_what_a_stage_need_not_have_has_a_default(name: str) -> None:
    stage = load_stage(f"{HERE}:{name}", "x")
    stage.start()
    stage.stop()
    assert not stage.has_frames
    with pytest.raises(LiveError, match=r"no method wait\(\)"):
        stage.wait()
    assert stage.inputs == ({"a": dict} if name == "Kept" else {})


def test_what_a_stage_has_is_called() -> None:
    stage = load_stage(f"{HERE}:Everything", "x")
    assert stage.has_frames
    assert load_stage(f"{HERE}:Derived", "x").has_frames
    assert stage.inputs == {"a": dict}
    stage.start()
    stage.wait()
    stage.restore(stage.snapshot())
    stage.stop()
    assert stage.process({}).payload == ["start", "wait", "snapshot", "restore", "stop"]


@pytest.mark.parametrize("name", ["double", "Arm"])
def test_what_is_an_actuator(name: str) -> None:
    actuator = load_actuator(f"{HERE}:{name}", "x")
    actuator.hold()
    actuator.zero()
    actuator.stop()
    assert actuator.inputs == {}


def test_what_tells_a_utilisation() -> None:
    assert callable(load_function(f"{HERE}:double", "--accelerator"))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("no_such_module:Name", "importing no_such_module failed (ModuleNotFoundError: No module"),
        ("stages_that_fail:Name", "No module named 'no_such_package_at_all'"),
        (f"{HERE}:Bear", f"{HERE} has no 'Bear'; did you mean 'Bare'?"),
        (f"{HERE}:Needs", "Needs() failed (TypeError: "),
        (f"{HERE}:Fails", "Fails() failed (OSError: no camera)"),
        (f"{HERE}:Nothing", "Nothing is no stage: it has no method process(inputs)"),
        (f"{HERE}:number", "number is no stage"),
    ],
)
def test_what_is_none_is_told_with_its_field(name: str, words: str) -> None:
    with pytest.raises(LiveError) as caught:
        load_stage(name, "tasks.a.run")
    assert str(caught.value).startswith("tasks.a.run: ")
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("name", "words"),
    [("Half", "Half has no method zero()"), ("Bare", "Bare is no actuator")],
)
def test_an_actuator_needs_all_its_methods(name: str, words: str) -> None:
    with pytest.raises(LiveError, match=r"live\.actuators\.control: ") as caught:
        load_actuator(f"{HERE}:{name}", "live.actuators.control")
    assert words in str(caught.value)


@pytest.mark.parametrize(("name", "words"), [("number", "cannot be called"), ("", "of the form")])
def test_a_utilisation_needs_a_function(name: str, words: str) -> None:
    with pytest.raises(LiveError, match="--accelerator: ") as caught:
        load_function(f"{HERE}:{name}" if name else HERE, "--accelerator")
    assert words in str(caught.value)
