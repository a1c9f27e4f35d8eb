"""Numbers in names count by their value."""

from snowsplat.util.natural_order import natural_key


def test_names_are_in_the_order_of_their_numbers():
    assert sorted(["img_9", "img_10", "img_09"], key=natural_key) == ["img_09", "img_9", "img_10"]
    assert sorted(["b10/1", "a10", "a1b", "b9/10", "a2", "b9/9"], key=natural_key) == [
        *("a1b", "a2", "a10", "b9/9", "b9/10", "b10/1")
    ]


def test_all_names_can_be_compared():
    names = ["1", "a", "1a", "a1", "", "٣", "a²", "\ud800", "9" * 5000, "01", "1"]
    ordered = sorted(names, key=natural_key)
    names.reverse()
    assert sorted(names, key=natural_key) == ordered
