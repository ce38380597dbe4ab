"""The table of seeded mutants fits the code; `python tests/mutants.py` applies them."""

from mutants import REPOSITORY, table


def test_each_mutant_changes_one_place_and_names_tests_that_are_there() -> None:
    mutants = table()
    assert len(mutants) >= 60
    places = {m.name: (REPOSITORY / "vislam" / m.file).read_text(encoding="utf-8").count(m.old) for m in mutants}
    assert {name: count for name, count in places.items() if count != 1} == {}, "the code has moved on: follow it"
    assert all(m.old != m.new for m in mutants)
    paths = {word for m in mutants for word in m.tests.split(" -k ")[0].split()}
    assert [path for path in paths if not (REPOSITORY / "tests" / path).exists()] == []
