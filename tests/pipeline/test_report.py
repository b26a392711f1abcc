"""What a run reports, also where it stopped."""

import json

import numpy as np
import pytest

from pipeline.cameras import save_views
from pipeline.options import Options
from pipeline.report import improvements, write_recording
from pipeline.sfm.pose_checks import check, views_of
from pipeline.stages import reconstruct
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError
from sdfsim.base.files import write_arrays
from tests.helpers.photos import photo, result


def test_the_page_names_every_photo_and_the_recording_shows_the_cameras(photos, tmp_path, act):
    found = result(3, 2)

    def posed(run, work):
        save_views(views_of(found, [photo(k) for k in range(3)]), work / "cameras.json")
        arrays = {"xyz": np.ones((5, 3)), "rgb": np.zeros((5, 3), np.uint8), "error": np.zeros(5)}
        write_arrays(work / "sparse.npz", {**arrays, "point_of": np.zeros(0, int), "view_of": np.zeros(0, int)})
        checks = check(found, [photo(k) for k in range(3)])
        return {
            **checks,
            "left_out": [{"photo": "2.png", "kind": "overlap", "why": "too few matches", "hopeful": True}],
        }

    act("poses", posed)
    out = tmp_path / "out"
    report = reconstruct(photos, out, until_stage="poses")
    text = (out / "report.md").read_text()
    assert "| 0.png | posed |" in text and "| 2.png | left out | too few matches |" in text
    assert report["paths"]["report"] == str(out / "report.md")
    assert [row["state"] for row in report["photos"]] == ["posed", "posed", "left out"]
    made = write_recording(out, report["stages"])
    assert made is not None and made.read_bytes()[:3] == b"RRF"


def test_a_run_that_stopped_says_where_and_why(photos, tmp_path, act):
    def failing(run, work):
        (work / "checks.json").write_text(json.dumps(check(result(6, 1, features=20), [photo(k) for k in range(6)])))
        raise SdfsimError("camera poses: only 1 of 6", "take sharper photos", exit_code=EXIT_QUALITY)

    act("poses", failing)
    with pytest.raises(SdfsimError) as caught:
        reconstruct(photos, tmp_path / "out")
    assert caught.value.exit_code == EXIT_QUALITY
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["error"] == {
        "stage": "poses", "message": "camera poses: only 1 of 6", "hint": "take sharper photos",
    }  # fmt: skip
    assert report["poses"]["posed"] == 1 and any("too little to see" in line for line in report["improve"])
    assert "It stopped in the poses stage" in (tmp_path / "out" / "report.md").read_text()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (Options(preset="quick"), "--preset standard"),
        (Options(preset="standard"), "more and sharper photos"),
        (Options(preset="standard", budget=60.0), "a larger --budget"),
    ],
)
def test_nobody_is_reported_to_do_what_they_did(options, said, photos, tmp_path, act):
    (line,) = improvements({"poses": {}, "stages": {}, "photos": [], "psnr": 12.0, "failed_checks": []}, options)
    assert said in line and f"--preset {options.preset}" not in line

    def failing(**places):
        raise SdfsimError("mesh: the field holds no surface", exit_code=EXIT_QUALITY)

    for stage in ("photos", "poses", "distill"):
        act(stage, lambda run, work: {})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.mesh.meshing.make_meshes", lambda *places, **named: failing())
        with pytest.raises(SdfsimError, match="mesh: ") as caught:
            reconstruct(photos, tmp_path / "out", preset=options.preset, budget=options.budget)
    assert said in caught.value.hint and f"--preset {options.preset}" not in caught.value.hint
