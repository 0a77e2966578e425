"""The DEM's answers to states of roll-outs, and training on them: real Yade, embedded cases, a bundle of 20 updates."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from data_gen import answers as room
from data_gen.answers import answers, own_states
from data_gen.continuation import continue_dem
from gns_pyg import bundle
from gns_pyg.config import CONF
from gns_pyg.data.datamodule import EMBEDDED, DataConfig, open_case, split
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.data.windows import Answers
from gns_pyg.errors import ConfigError, DataError, NumericalError
from gns_pyg.scene.scene import Scene
from tests.integration.runs import train

needs_yade = [
    pytest.mark.yade,
    pytest.mark.skipif(shutil.which("yade") is None, reason="Yade is not installed (apt-get install yade)"),
]


def config(*overrides: str):
    with initialize_config_dir(CONF, version_base="1.3"):
        return compose("answers", list(overrides))


@pytest.fixture(scope="module")
def asked(trained, tmp_path_factory) -> Path:
    """Answers to every 40th step of the roll-outs of one training case."""
    out, (folder, _) = tmp_path_factory.mktemp("answers"), trained
    card = bundle.describe(folder / "bundle")["card"]
    case = min(card["cases"]["train"])
    cases = out / "cases"
    cases.mkdir()
    shutil.copy(EMBEDDED / "hopper_small" / case, cases)
    told = answers(config(f"bundle={folder}/bundle", f"data.dir={cases}", f"out={out}", "every=40"))
    assert told == {"files": [str(out / case.replace("case", "answers"))], "states": 2}
    return out


@needs_yade[0]
@needs_yade[1]
class TestWithYade:
    def test_pairs_are_a_roll_out_s_states_and_what_the_dem_makes_of_them(self, asked, trained) -> None:
        file = Trajectory(asked / "answers_000.h5")
        simulator = bundle.load(trained[0] / "bundle")
        case = open_case(asked / "cases" / "case_000.h5", simulator.scene)
        assert file.times_s == pytest.approx([0.5, 0.51, 0.9, 0.91])
        assert file.run["rolled_out_from"] == case.content_hash()
        for pair, start in enumerate(own_states(simulator, case, 10, 40)):
            assert file.read("position", 2 * pair, 2 * pair + 1)[0] == pytest.approx(start.pos, abs=1e-9)
            assert file.read("angular_velocity", 2 * pair, 2 * pair + 1)[0] == pytest.approx(start.ang_vel, abs=1e-5)
            alone = continue_dem(case, Scene.from_config(case.scene), start, 2)
            answer = file.read("position", 2 * pair + 1, 2 * pair + 2)[0]
            assert answer == pytest.approx(alone[1], abs=1e-9)  # the answer before left no trace

    def test_training_takes_them_beside_the_recorded_windows(self, asked, trained, tmp_path) -> None:
        options = ["experiment=hopper", "training.updates=2", "training.unroll=0", "training.loss_knee=0.02"]
        options += [f"data.answers=[{asked}]", f"training.start_from={trained[0]}/bundle"]
        train(tmp_path, *options)
        card = bundle.describe(tmp_path / "bundle")["card"]
        file = Trajectory(asked / "answers_000.h5")
        assert card["cases"]["answers"] == {f"{asked.name}/answers_000.h5": file.content_hash()}
        before, after = (bundle.load(folder / "bundle").state_dict() for folder in (trained[0], tmp_path))
        moved = max(float((after[key] - before[key]).abs().max()) for key in before)
        assert 0 < moved < 0.01  # two updates from the bundle's weights, not from the seed's

    def test_windows_of_pairs(self, asked) -> None:
        file = Trajectory(asked / "answers_000.h5")
        pairs = Answers([file, file])
        assert len(pairs) == 4
        window = pairs[3]
        assert torch.equal(window.pos[1:], torch.from_numpy(file.read("position", 2, 4)))
        assert window.time_s.item() + 0.01 == pytest.approx(0.9)

    def test_a_finished_file_is_kept(self, asked, trained, monkeypatch) -> None:
        monkeypatch.setattr(room, "run_dem", lambda *_, **__: pytest.fail("Yade was started"))
        bundled = f"bundle={trained[0]}/bundle"
        assert answers(config(bundled, f"data.dir={asked}/cases", f"out={asked}"))["states"] == 0

    def test_answers_to_unseen_cases_are_refused(self, asked, trained, tmp_path) -> None:
        scene = bundle.load(trained[0] / "bundle").scene
        for case in (1, 2, 3):
            shutil.copy(EMBEDDED / "hopper_small" / f"case_{case:03d}.h5", tmp_path)
        with pytest.raises(DataError, match="training cases only"):
            split(scene, DataConfig(dir=str(tmp_path), answers=[str(asked)]))


def test_no_answers_say_how_to_make_them(trained, tmp_path) -> None:
    scene = bundle.load(trained[0] / "bundle").scene
    with pytest.raises(DataError, match=r"python -m data_gen\.answers"):
        split(scene, DataConfig(answers=[str(tmp_path)]))


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["out=null"], "out"),
        (["every=1"], "at least 2"),
        (["every=often"], "every"),
    ],
)
def test_what_cannot_be_is_refused_before_yade_starts(overrides, told, trained, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(room, "run_dem", lambda *_, **__: pytest.fail("Yade was started"))
    with pytest.raises(ConfigError, match=told):
        answers(config(f"bundle={trained[0]}/bundle", f"out={tmp_path}", *overrides))


def test_answers_and_own_steps_do_not_go_together(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"training\.unroll"):
        train(tmp_path, "experiment=hopper", "data.answers=[somewhere]", "training.unroll=3")


def test_training_starts_only_from_a_bundle_of_the_same_model(trained, tmp_path) -> None:
    start = f"training.start_from={trained[0]}/bundle"
    with pytest.raises(ConfigError, match="hidden = "):
        train(tmp_path, "experiment=hopper", start, "model.hidden=16")


def test_a_roll_out_that_diverges_is_asked_about_as_far_as_it_held(trained, monkeypatch) -> None:
    simulator = bundle.load(trained[0] / "bundle")
    case = split(simulator.scene, DataConfig()).train[0]

    def breaks(step, state, n_steps):
        for _ in range(5):
            state = step(state)
            yield state
        raise NumericalError("roll-out step 6", "nan", "finite values", "-")

    monkeypatch.setattr(room, "rollout", breaks)
    with torch.inference_mode():
        found = own_states(simulator, case, 10, 2)
        assert [start.time_s for start in found] == pytest.approx([0.12, 0.14])
        assert np.isfinite(found[1].pos).all()
        with pytest.raises(ConfigError, match="train longer"):
            own_states(simulator, case, 10, 6)


def test_training_starts_from_a_scene_of_another_symmetry(tmp_path) -> None:
    """The inclined drum has none; what a drum's networks know of contacts holds there too."""
    one = ["training.updates=1", "data.test_fraction=0"]
    train(tmp_path / "drum", "experiment=drum", *one)
    start = f"training.start_from={tmp_path / 'drum' / 'bundle'}"
    train(tmp_path / "inclined", "experiment=inclined_drum", start, *one, "training.lr_start=1e-12")
    drum, inclined = (bundle.load(tmp_path / name / "bundle").state_dict() for name in ("drum", "inclined"))
    networks = [key for key in drum if not key.startswith("boundary.")]
    assert networks
    assert all(torch.allclose(drum[key], inclined[key], atol=1e-9) for key in networks)
