"""The lines about finished stages."""

from snowsplat.cli.stage_lines import described


def test_what_is_fixed_to_the_frame_follows_the_number_of_photos():
    gathered = {
        "photos": [{}] * 8,
        "skipped": [["a.jpg", "is too blurred"]],
        "notes": ["bars at the top and bottom: cut off in all 8 photos"],
    }
    assert described("photos", gathered) == [
        "8 photos, 1 skipped",
        "bars at the top and bottom: cut off in all 8 photos",
        "a.jpg: is too blurred",
    ]


def test_records_of_earlier_versions_have_no_notes():
    assert described("photos", {"photos": [{}] * 8, "skipped": []}) == ["8 photos"]
