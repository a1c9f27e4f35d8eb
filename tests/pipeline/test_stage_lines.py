"""The lines about finished stages."""

from snowsplat.pipeline import stage_lines


def described(stage: str, result: dict) -> list[str]:
    return [str(line) for line in stage_lines.described(stage, result)]


def test_what_is_fixed_to_the_frame_follows_the_number_of_photos():
    gathered = {
        "photos": [{}] * 8,
        "left_out": [{"photo": "a.jpg", "stage": "photos", "reason": "is too blurred"}],
        "notes": ["bars at the top and bottom: cut off in all 8 photos"],
    }
    assert described("photos", gathered) == [
        "8 photos, 1 skipped",
        "bars at the top and bottom: cut off in all 8 photos",
        "a.jpg: is too blurred",
    ]


def test_records_of_earlier_versions_have_no_notes():
    assert described("photos", {"photos": [{}] * 8, "left_out": []}) == ["8 photos"]


def test_the_last_part_says_how_many_photos_it_leaves_out():
    (line,) = described("all", {"steps": 180, "photos": 19})  # as earlier versions wrote it
    assert "180 more steps with all 19 photos" in line
    (line,) = described("all", {"steps": 180, "photos": 18, "left_out": 1})
    assert "180 more steps with 18 of 19 photos (the scene does not explain the other)" in line
    (line,) = described("all", {"steps": 180, "photos": 17, "left_out": 2})
    assert "17 of 19 photos (the scene does not explain the others)" in line
