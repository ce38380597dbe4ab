"""What a text asks for is bounded by its length: no aliases, dotted keys or nesting make much of little."""

import pytest

from vislam.core.errors import DataError
from vislam.core.reading import MAX_TOML_BYTES, MAX_YAML_BYTES, parse_toml, parse_yaml


def yaml_bomb(level: str, levels: int) -> str:
    """Return lines of which each has nine or more times what the one before it has."""
    return "a0: &a0 {k: 1}\n" + "".join(
        f"a{i}: &a{i} {level.replace('*', f'*a{i - 1}')}\n" for i in range(1, levels + 1)
    )


@pytest.mark.parametrize("level", ["{<<: [*,*,*,*,*,*,*,*]}", "[*,*,*,*,*,*,*,*,*]", "{a: *, b: *, c: *, d: *, e: *}"])
def test_aliases_and_merge_keys_cannot_multiply(level: str) -> None:
    assert parse_yaml(yaml_bomb(level, 2))["a0"] == {"k": 1}
    for levels in (8, 40):
        with pytest.raises(ValueError, match="more than any such file holds"):
            parse_yaml(yaml_bomb(level, levels))


def test_ordinary_anchors_are_read() -> None:
    text = "first: &c {fx: 1, size: &s [640, 480]}\nsecond:\n  <<: *c\n  fx: 2\nagain: &d 3\nlast: [*s, *d]\n"
    expected = {"fx": 2, "size": [640, 480]}
    assert parse_yaml(text)["second"] == expected
    assert parse_yaml(text)["last"] == [[640, 480], 3]


WRONG = (
    "[" * MAX_YAML_BYTES, "{a: " * 50_000, "- " * 50_000, "? " * 50_000, "".join(" " * i + "a:\n" for i in range(300)),
    "a: &a [*a]", "a: &a {<<: *a}", "a: *b", "a: 1" + ":1" * 100_000, "a: " + "9" * 5000, "a: !!int ''",
    "a: !!bool x", "a: !!timestamp x", "a: 2020-13-45", "!!python/object:os.system x", "? {a: b}\n: c", "a: \0",
    "a: \ud800", "a: [", "a: 0x" + "f" * 5000, "a: !!int '0b" + "1" * 5000 + "'",
)  # fmt: skip


@pytest.mark.parametrize("text", WRONG)
def test_yaml_that_is_deep_circular_or_wrong_is_a_value_error_of_one_short_line(text: str) -> None:
    with pytest.raises(ValueError) as refused:
        parse_yaml(text)
    assert len(str(refused.value)) <= 250 and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "text",
    [
        "a." * 50_000 + "a = 1", "[" + "a." * 5000 + "a]", "a = " + "[" * 50_000, "a = " + "{a = " * 20_000,
        "[" + "a." * 80 + "a]", "a = " + "9" * 5000, "#" * (MAX_TOML_BYTES + 1), "a = 2020-99-99",
    ],
)  # fmt: skip
def test_toml_that_is_deep_large_or_wrong_is_a_value_error(text: str) -> None:
    with pytest.raises(ValueError):
        parse_toml(text)


def test_keys_and_numbers_of_settings_are_no_deep_ones() -> None:
    numbers = ", ".join(["0.5"] * 36)
    assert parse_toml(f"[a.b.c]\nd.e = [{numbers}]\n")["a"]["b"]["c"]["d"]["e"] == [0.5] * 36


def test_a_message_that_quotes_a_whole_file_keeps_its_two_ends() -> None:
    said = str(DataError("x.yaml: got " + "\x1b[31m" * 10**6 + "; correct it"))
    assert said.startswith("x.yaml: got ") and said.endswith("; correct it") and len(said) < 10_000
