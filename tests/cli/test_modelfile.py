"""A model by the name of a built-in system or from a file, which leaves no trace behind."""

from __future__ import annotations

import sys

import pytest
from small_rig import MODEL

from bayesoleo._workflow.model_files import load_effects, load_model
from bayesoleo.effects import catalogue
from bayesoleo.errors import ModelError, ModelWarning


def test_built_in_and_file(model):
    assert load_model("duffing").name == "duffing"
    for text in (f"{model}", f"{model}:", f"{model}:model"):
        assert load_model(text).name == "linear oscillator"


def test_module_and_path_are_as_before(model, tmp_path):
    (tmp_path / "masses.py").write_text("MASS = 2.5\n")
    text = MODEL.replace("Parameter(1.0,", "Parameter(MASS,")
    model.write_text("from dataclasses import dataclass\nfrom masses import MASS\n" + text)
    path, before = list(sys.path), sorted(tmp_path.rglob("*"))
    modules = {name for name, module in sys.modules.items() if module is not None}
    try:
        assert load_model(str(model)).parameters["mass"].value == 2.5
        assert set(sys.modules) - modules == {"masses"}
    finally:
        sys.modules.pop("masses", None)
    assert sys.path == path
    assert "spring" not in sys.modules
    assert sorted(tmp_path.rglob("*")) == before


def test_dataclasses_work_in_a_model_file(model):
    lines = [
        "from __future__ import annotations",
        "from dataclasses import dataclass",
        "@dataclass",
        "class Mass:",
        "    value: float = 1.0",
    ]
    model.write_text("\n".join(lines) + MODEL)
    assert load_model(str(model)).name == "linear oscillator"


def test_error_names_the_line_of_the_file_and_not_of_what_it_calls(model):
    model.write_text("import json\n\njson.loads('{')\n")
    with pytest.raises(ModelError, match=r"spring.py: line 3: JSONDecodeError: ") as caught:
        load_model(str(model))
    assert "\n" not in str(caught.value)


def test_what_nothing_uses_is_named(model):
    model.write_text(MODEL.replace("mass*ddot", "2.0*ddot"))
    with pytest.warns(ModelWarning, match=r"spring.py: parameter mass of model 'linear osc"):
        load_model(str(model))


def test_what_effects_look_for_by_name_may_wait_for_them(model):
    ambient = 'parameters={\n        "ambient_temperature": Parameter(293.0, "K", fixed=True),'
    text = MODEL.replace("parameters={", ambient)
    assert text != MODEL
    model.write_text(text)
    assert "ambient_temperature" in load_model(str(model)).parameters


def test_folder_cannot_be_a_model(tmp_path):
    (tmp_path / "a.py").mkdir()
    with pytest.raises(ModelError, match=r"a.py: cannot be read: Is a directory"):
        load_model(str(tmp_path / "a.py"))


EFFECTS = """
from bayesoleo.effects import catalogue, force_effect

drag = force_effect("cubic_drag", "damping", "c3*velocity**3", {"c3": "force/(position/s)**3"})
effects = [*catalogue(), drag]
same = force_effect("viscous_damping", "damping", "c*velocity", {"c": "force/(position/s)"})
"""


def test_effects_of_a_file_come_after_the_catalogue(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(EFFECTS)
    for text in (f"{path}", f"{path}:effects", f"{path}:drag"):
        loaded = load_effects(text)
        assert loaded[:-1] == catalogue()
        assert loaded[-1].id == "cubic_drag"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("mine.py:drga", "mine.py: no such object .got 'drga'.; write .*mine.py:drag"),
        ("mine.py:catalogue", "mine.py: catalogue holds .*, not an Effect; write"),
        ("mine.py:same", "mine.py: there is an effect of this id .got 'viscous_damping'."),
        ("none.py:drag", "none.py: there is no such file; write file.py:object"),
        ("cubic_drag", "names no file of effects .got .*; write file.py:object"),
    ],
)
def test_effects_that_cannot_be_used(tmp_path, name, message):
    (tmp_path / "mine.py").write_text(EFFECTS)
    with pytest.raises(ModelError, match=message):
        load_effects(str(tmp_path / name))
