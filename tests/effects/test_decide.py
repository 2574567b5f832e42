"""The rules: pure decisions from what a scene is like and what the user says."""

from dataclasses import replace

import pytest
from configs import build_data, effect_settings

from gsgan.data.scene_info import SceneInfo
from gsgan.data.surface_colours import SurfaceColours
from gsgan.effects import (
    EFFECT_NAMES,
    Effects,
    ModelParts,
    decide,
)
from gsgan.effects.decide import CHOICES
from gsgan.utils.errors import ConfigError

ALIKE = SurfaceColours(difference=0.01, residual=0.05)
GLOSSY = replace(ALIKE, residual=0.12)
CAMERAS = tuple(f"cam{i}" for i in range(6))


def scene(**changes) -> SceneInfo:
    """Six matt cameras that agree, one scale, no lens, a body pose, dark clothes."""
    plain = SceneInfo(
        camera_names=(*CAMERAS, "held_out"), n_train_cameras=6, train_cameras=CAMERAS,
        has_distortion=False, has_labels=False, n_labels=0, label_names=(), has_body_pose=True,
        body="free", skeleton="mediapipe33", limb_length_sum=4.0, centre=(0.0, 0.0, 1.0), frames=10,
        scale_train=(50.0, 60.0), surface=ALIKE, darkest=0.1,
    )  # fmt: skip
    return replace(plain, **changes)


def on(effects: Effects) -> set[str]:
    return {name for name, effect in effects if effect.on}


def test_a_plain_scene_calls_for_what_it_always_had():
    assert on(decide(scene(), effect_settings())) == {"random_background"}


@pytest.mark.parametrize(
    ("change", "effect", "value"),
    [
        ({"surface": GLOSSY}, "view_dependence", 2),
        (
            {"surface": replace(ALIKE, difference=0.07)},
            "colour_correction",
            "on",
        ),
        ({"has_distortion": True}, "distortion", "undistort"),
        ({"scale_train": (40.0, 60.0)}, "antialias", "on"),
        ({"body_inside": 1.0}, "body_points", "on"),
        ({"darkest": 0.4}, "random_background", "off"),
    ],
)
def test_each_call_turns_on_its_own_effect_and_no_other(change, effect, value):
    before, after = (
        decide(scene(), effect_settings()),
        decide(scene(**change), effect_settings()),
    )
    assert getattr(after, effect).value == value
    assert {
        n
        for n in EFFECT_NAMES
        if getattr(before, n).value != getattr(after, n).value
    } == {effect}


@pytest.mark.parametrize(
    ("change", "effect"),
    [
        # medians move with highlights: half of what is left explains as much
        (
            {"surface": replace(ALIKE, difference=0.05, residual=0.12)},
            "colour_correction",
        ),
        ({"surface": None}, "colour_correction"),
        ({"surface": None}, "view_dependence"),
        ({"surface": GLOSSY, "n_train_cameras": 1}, "view_dependence"),
        ({"scale_train": (47.0, 60.0)}, "antialias"),
    ],
)
def test_what_could_be_taken_for_a_call_is_none(change, effect):
    assert not getattr(decide(scene(**change), effect_settings()), effect).on


@pytest.mark.parametrize("scales", [(0.5, 1), (1, 2), (2, 3), (0.5, 0.9)])
def test_scales_that_are_to_be_rendered_call_for_antialias(scales):
    assert not decide(scene(), effect_settings()).antialias.on
    found = decide(scene(), effect_settings(rendered_scales=scales)).antialias
    assert found.on
    assert "differ by" in found.why


@pytest.mark.parametrize(
    "scales", [(1,), (2, 1), (0, 1), ("a", 1), (1, float("nan"))]
)
def test_rendered_scales_are_two_rising_numbers(scales):
    with pytest.raises(ConfigError, match="rendered_scales"):
        effect_settings(rendered_scales=scales)


@pytest.mark.parametrize(
    ("cameras", "degree"), [(2, 1), (3, 1), (4, 2), (7, 2), (8, 3), (30, 3)]
)
def test_the_degree_follows_the_number_of_cameras(cameras, degree):
    glossy = scene(n_train_cameras=cameras, surface=GLOSSY)
    assert decide(glossy, effect_settings()).degree == degree


@pytest.mark.parametrize(
    ("setting", "change", "why"),
    [
        (
            {"distortion": "undistort"},
            {},
            r"effects\.distortion=undistort",
        ),
        (
            {"colour_correction": "on"},
            {"n_train_cameras": 1},
            r"effects\.colour_correction=on",
        ),
        (
            {"body_points": "on"},
            {"has_body_pose": False},
            r"effects\.body_points=on.*body pose",
        ),
        (
            {"body_points": "on"},
            {"body": "smpl"},
            r"effects\.body_points=on.*file",
        ),
        ({"only": ["distortion"]}, {}, r"effects\.distortion=on"),
    ],
)
def test_forcing_the_impossible_is_one_sentence_or_left_out(
    setting, change, why
):
    with pytest.raises(ConfigError, match=why) as caught:
        decide(scene(**change), effect_settings(**setting))
    assert "\n" not in str(caught.value)
    lenient = decide(
        scene(**change), effect_settings(**setting, impossible="off")
    )
    assert not getattr(lenient, next(iter(setting)), lenient.distortion).on


def test_a_lens_that_painting_does_not_know_is_refused_or_undistorted():
    rational = scene(has_distortion=True, has_rational_lens=True)
    with pytest.raises(ConfigError, match=r"distortion=project.*k4, k5, k6"):
        decide(rational, effect_settings(distortion="project"))
    lenient = decide(
        rational, effect_settings(distortion="project", impossible="off")
    )
    assert lenient.distortion.value == "undistort"
    assert "k4" in lenient.distortion.why


@pytest.mark.parametrize("word", ["auto", "off", "undistort", "project"])
def test_a_list_leaves_lenses_to_their_own_word(word):
    bent = scene(has_distortion=True)
    found = decide(bent, effect_settings(distortion=word, only=["antialias"]))
    assert (
        found.distortion
        == decide(bent, effect_settings(distortion=word)).distortion
    )
    assert found.distortion.on == (word != "off")
    named = decide(bent, effect_settings(distortion=word, only=["distortion"]))
    assert named.distortion.on


def test_images_are_read_as_the_list_of_effects_says(tiny):
    """The data has the lens that the table of effects names."""
    config = tiny("effects.only=[distortion]", "effects.distortion=off")
    assert build_data(config).lens == "undistort"


@pytest.mark.parametrize(
    ("model", "effect", "why"),
    [
        (
            ModelParts(points=False),
            "body_points",
            "has no points on the skeleton",
        ),
        (ModelParts(splats=False), "antialias", "has no Gaussians"),
    ],
)
def test_an_effect_that_the_model_lacks_is_off_or_refused(model, effect, why):
    auto = decide(
        scene(body_inside=1.0, scale_train=(51.0, 590.0)),
        effect_settings(),
        model,
    )
    assert why in getattr(auto, effect).why
    assert not getattr(auto, effect).on
    forced = effect_settings(**{effect: "on"})
    with pytest.raises(ConfigError, match=rf"effects\.{effect}=on"):
        decide(scene(), forced, model)
    assert not getattr(
        decide(scene(), replace(forced, impossible="off"), model), effect
    ).on


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (
            {"antialias": "maybe"},
            r"effects\.antialias.*auto, on, off",
        ),
        ({"view_dependence": 4}, r"effects\.view_dependence"),
        ({"degree_cameras": [4, 2, 8]}, r"effects\.degree_cameras"),
        ({"only": ["colours"]}, r"effects\.only"),
        ({"only": "antialias"}, r"effects\.only"),
        (
            {"impossible": "maybe"},
            r"effects\.impossible.*error, off",
        ),
    ],
)
def test_wrong_settings_are_named(wrong, named):
    with pytest.raises(ConfigError, match=named):
        effect_settings(**wrong)


def test_configs_say_what_their_names_say(compose):
    from hydra.utils import instantiate

    none, every = (
        instantiate(compose("train", f"effects={name}").effects)
        for name in ("none", "all")
    )
    assert on(decide(scene(), none)) == set()
    # the camera's own
    assert on(decide(scene(has_distortion=True), none)) == {"distortion"}
    found = on(decide(scene(has_distortion=True), every))
    assert found == set(CHOICES)
    assert on(decide(scene(), every)) == found - {"distortion"}
    listed = instantiate(compose("train", "effects.only=[antialias]").effects)
    assert on(decide(scene(), listed)) == {"antialias"}


def test_forced_values_win_over_the_scene():
    settings = effect_settings(
        view_dependence=3, antialias=True, random_background=False
    )
    found = decide(scene(), settings)
    assert found.degree == 3
    assert on(found) == {"view_dependence", "antialias"}
    assert decide(scene(), effect_settings(view_dependence="on")).degree == 2
    assert on(decide(scene(), effect_settings(only=["antialias"]))) == {
        "antialias"
    }


PRINTED = {
    "body_inside": 1.0,
    "texture": 0.6,
    "scale_train": (190.0, 220.0),
}


def test_fine_print_on_a_body_is_registered():
    found = decide(scene(**PRINTED), effect_settings()).registration
    assert found.on
    assert "0.60" in found.why


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"texture": 0.1}, "little that flow can follow"),
        ({"scale_train": (90.0, 110.0)}, "off by less than a pixel"),
        ({"n_train_cameras": 1}, "does not see depth"),
        ({"body_inside": 0.5}, "no Gaussians are on a body"),
        ({"has_body_pose": False}, "no Gaussians are on a body"),
    ],
)
def test_why_a_surface_is_not_registered(changes, why):
    found = decide(scene(**{**PRINTED, **changes}), effect_settings())
    assert not found.registration.on
    assert why in found.registration.why


def test_registration_without_a_body_is_refused_or_left_out():
    settings = effect_settings(registration="on", body_points="off")
    with pytest.raises(ConfigError, match="no Gaussians are on a body"):
        decide(scene(**PRINTED), settings)
    settings = replace(settings, impossible="off")
    assert not decide(scene(**PRINTED), settings).registration.on


def test_checkpoints_from_before_and_after_an_effect_existed_are_read():
    stored = decide(scene(), effect_settings()).plain()
    del stored["registration"]
    stored["generator"] = {
        "value": "on",
        "why": "no effect now",
        "forced": False,
    }
    assert not Effects.from_plain(stored).registration.on


@pytest.mark.parametrize(
    ("changes", "parts", "value", "why"),
    [
        ({"n_train_cameras": 1, "degrees_seen": 330}, {}, "on", "330 of 360"),
        ({"n_train_cameras": 1, "degrees_seen": 90}, {}, "off", "90 of 360"),
        ({"degrees_seen": 360}, {}, "on", "360 of 360"),
        ({"degrees_seen": 270}, {}, "off", "270 of 360"),
        ({"n_train_cameras": 1}, {"network": False}, "off", "no Ψ"),
    ],
)
def test_light_is_found_where_the_person_is_seen_from_all_sides(
    changes, parts, value, why
):
    found = decide(scene(**changes), effect_settings(), ModelParts(**parts))
    assert found.light.value == value
    assert why in found.light.why


def test_a_run_is_not_resumed_with_other_effects():
    before, now = (
        decide(scene(), effect_settings()),
        decide(scene(darkest=1.0), effect_settings()),
    )
    before.check_same(before.plain())
    with pytest.raises(ConfigError, match=r"effects\.random_background.* on"):
        now.check_same(before.plain())
