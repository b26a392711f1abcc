"""The commands `fit` and `evaluate`: interruption, stages, tables."""

from __future__ import annotations

from tests.cli.conftest import run


def test_fitting_a_folder_ends_with_its_scene(tmp_path, monkeypatch):
    calls = []

    def run_stage(name, folder, *, progress, **options):
        calls.append((name, {key: value for key, value in options.items() if value is not None}))
        return {"seconds": {name: 1.0}, "paths": {}, "failed_checks": [], "notes": ["a metre is a guess"]}

    monkeypatch.setattr("pipeline.stages.run_stage", run_stage)
    done = run("fit", tmp_path, "--recipe", "paper")
    assert done.exit_code == 0 and done.stderr == "a metre is a guess\n"
    assert calls == [("fit", {"recipe": "paper", "device": "auto"}), ("scene", {})]


def test_an_evaluation_is_three_tables(tmp_path, monkeypatch):
    errors = {
        "50": {
            "seconds": 1.0,
            "translation_rmse": 0.1714,
            "translation_rmse_95": [0.15, 0.19],
            "rotation_error": 12.04,
            "rotation_error_95": [11.0, 13.0],
            "at_frame": {
                "translation_rmse": 0.321,
                "translation_rmse_95": [0.3, 0.4],
                "rotation_error": 15.0,
                "rotation_error_95": [14.0, 16.0],
            },
        }
    }
    who = ("model", "ballistic", "teacher 0", "teacher 1e-6")
    depth = {"percentile_95": 0.0123, "worst": 0.2, "steps_with_contact": 7}
    report = {
        "model_name": "small",
        "trajectories": 60,
        "bodies": 400,
        "ms_per_step_per_trajectory": 1.5,
        "steps": 50,
        "steps_asked": 60,
        "outside_training": ["largest side of a body, m: 1 to 3 here, small was trained on 0.7 to 2"],
        "engine_substep": 0.0,
        "chaos_floor": {"perturbations": {"0": errors, "1e-6": errors}, "median_farthest_unperturbed_m": 0.00053},
        "median_survival_s": {name: {"0.25": None if "1e" in name else 0.74} for name in who},
        "penetration": {"model": depth, "teacher": depth, "geometry": {"cube": "pieces"}, "every": 10},
        "energy_gain": {name: {"mean": 0.01, "worst": 0.5} for name in ("model", "teacher")},
        "resting_speed": {"model": None, "teacher": None, "bodies": 0},
    }
    asked = {}

    def evaluate(data, **options):
        asked.update(options)
        return report | {"model": errors, "ballistic": errors}

    monkeypatch.setattr("sdfsim.evaluation.evaluate.evaluate", evaluate)
    lines = run("evaluate", tmp_path, "--free-flight", "learned", "--chaos-floor").stdout.splitlines()
    assert asked["steps"] == 50 and asked["free_flight"] == "learned" and asked["chaos_floor"]
    assert any("No dataset.json tells" in line for line in lines)
    assert any("Outside the model's training: largest side" in line for line in lines)
    assert any("ends after 50 steps; 60 were asked for" in line for line in lines)
    assert "50 steps = 1 s" in lines[1]
    assert [line.split("  ")[0] for line in lines[2:5]] == ["small", "teacher, 1e-6 m/s off", "ballistic"]
    assert all("0.171 (0.150 to 0.190)" in line and "12.0 (11.0 to 13.0)" in line for line in lines[2:5])
    assert len({line.index("12.0") for line in lines[2:5]}) == 1
    assert "frame 50 = 1 s" in lines[7]
    assert all(line.endswith("15.0") and "0.321" in line for line in lines[8:11])
    small, recorded, again, ballistic = (line.split() for line in lines[13:17])
    assert small == "small 0.0123 m 0.2000 m 1.00 % 50.00 % - 0.74 s".split()
    assert recorded[-1] == "-" and again[-3:] == [">", "1", "s"] and ballistic[-2:] == ["0.74", "s"]
    assert any("0.0005 m (median" in line for line in lines[17:])
    assert max(map(len, lines)) <= 120
