"""What is said of the run to make next."""

from __future__ import annotations

import pytest

from bayesoleo._report.sentences import hold_out_objects
from bayesoleo._report.structures import proposal_lines, proposal_table


def trial(sigmas, amplitude=0.05, run=None, information=0.9):
    pairs = [{"rivals": list(pair), "sigma": sigma} for pair, sigma in sigmas.items()]
    entry = {
        "frequency": 2.0,
        "mean": 0.12,
        "amplitude": amplitude,
        "information": information,
        "sigma": min(sigmas.values()),
        "pairs": pairs,
    }
    return entry if run is None else {"run": run, **entry}


def entry(**changed):
    given = {
        "round": 1,
        "question": "indistinguishable",
        "rivals": ["a", "b"],
        "drive": "displacement",
        "unit": "m",
        "runs": [trial({("a", "b"): 8.25})],
        "repeat": trial({("a", "b"): 0.4}, 0.02, "run 3", 0.1),
        "entropy": 0.98,
        "probabilities": [0.6, 0.4],
        "inseparable": [],
        "left_out": {},
        "note": "",
    }
    return given | changed


def test_two_rivals_are_told_with_the_run_in_an_engineers_units():
    question, answer = proposal_lines(entry())
    assert question == "These data cannot tell a, which was added, from b."
    assert "A run at 2.00 Hz, mean 120 mm, amplitude 50.0 mm is expected to tell 0.90 " in answer
    assert "bits of the 0.98 that are open; " in answer
    assert "no present run, made once more, more than 0.10." in answer


def test_what_is_told_of_the_best_run_is_what_it_was_ranked_by():
    """A repetition may separate the weakest pair further and tell less."""
    given = entry(repeat=trial({("a", "b"): 9.0}, 0.02, "run 3", 0.5))
    assert "0.90 bits" in proposal_lines(given)[1]
    assert "more than 0.50" in proposal_lines(given)[1]


def test_a_repetition_that_tells_as_much_is_told_as_such():
    given = entry(repeat=trial({("a", "b"): 9.0}, 0.02, "run 3", 0.899))
    assert proposal_lines(given)[1].endswith("; run 3, made once more, as much.")


def test_a_repetition_that_tells_more_than_any_new_run_is_told_first():
    line = proposal_lines(entry(repeat=trial({("a", "b"): 9.0}, 0.02, "run 3", 0.95)))[1]
    assert line.startswith("run 3, made once more, is expected to tell 0.95 bits")
    assert "one at 2.00 Hz" in line


def test_probabilities_of_structures_are_told():
    given = entry(question="structures", rivals=["a + c", "nothing"])
    question = proposal_lines(given)[0]
    assert question == "What is missing, by probability: a with c (0.60) and nothing (0.40)."


def test_effects_that_all_rivals_have_are_told_once():
    rivals = ["a + b + c", "a + b + d", "a + b"]
    given = entry(question="structures", rivals=rivals, note="others (probability 0.82)")
    given |= {"probabilities": [0.5, 0.3, 0.2]}
    question = proposal_lines(given)[0]
    expected = "What is missing beside a and b, by probability among these: "
    assert question == f"{expected}c (0.50), d (0.30) and nothing more (0.20)."


def test_structures_are_told_with_what_they_have_together():
    """Something outside, which predicts nothing, may have most of the probability."""
    given = entry(question="structures", probability=0.472)
    question, answer = proposal_lines(given)
    expected = "What is missing, by probability among these, which have 0.47 together: "
    assert question == f"{expected}a (0.60) and b (0.40)."
    assert "bits of the 0.98 that are open among these; " in answer
    question, answer, _ = proposal_lines(given | {"probability": 0.999, "note": "limits of x"})
    assert question == "What is missing, by probability: a (0.60) and b (0.40)."
    assert "that are open; " in answer


@pytest.mark.parametrize(("pooled", "single"), [(20.0, 28.0), (1.0, 28.0), (1.0, 1.0)])
def test_hold_out_runs_that_say_more_is_missing_are_told(pooled, single):
    """Probabilities follow from the fitted runs alone."""

    def errors(value):
        return {"ratio_to_noise": value, "limit": 1.2}

    runs = {"a": errors(9.0) | {"role": "fit"}, "e": errors(single) | {"role": "hold-out"}}
    summary = {
        "rounds": [{"error": {"angle": runs}}],
        "error_after": {"fit": {"angle": errors(9.0)}, "hold-out": {"angle": errors(pooled)}},
    }
    given = entry(question="structures", rivals=["a", "a + b"])
    text = proposal_lines(given, objection=hold_out_objects(summary))[0]
    said = "(0.40); yet the hold-out runs say that more is missing: the final model's error of"
    assert (said in text) is (single > 1.2)
    if pooled > 1.2:
        assert text.endswith("of angle there is 20.0 times its standard error.")
    elif single > 1.2:
        assert text.endswith("of angle in run e is 28.0 times its standard error.")


def test_three_effects_of_a_rival_are_seen_as_one():
    given = entry(question="structures", rivals=["a + b + c", "d"])
    question = proposal_lines(given)[0]
    assert question == "What is missing, by probability: a + b + c (0.60) and d (0.40)."


def test_a_variation_of_a_measured_run_is_told_by_what_it_changes():
    runs = [
        trial({("a", "b"): 3.0})
        | {"like": "drop 2", "change": "1.2 times its amplitude of force, 2 times its duration"}
    ]
    repeat = trial({("a", "b"): 1.0}, run="drop 1", information=0.2)
    repeat |= {"like": "drop 1", "change": "", "frequency": None, "mean": None, "amplitude": None}
    given = entry(runs=runs, repeat=repeat, drive=None)
    assert (
        "like drop 2 with 1.2 times its amplitude of force, 2 times its duration is"
        in proposal_lines(given)[1]
    )
    table = proposal_table(given)
    assert table.head[:3] == ["run", "as run", "changed"]
    assert [row[2] for row in table.rows] == [
        "1.2 times its amplitude of force, 2 times its duration",
        "nothing",
    ]


def test_of_parameters_the_most_improved_are_told():
    best = trial({("a", "b"): 0.0}) | {"pairs": [], "sigma": None}
    best["sd_ratio"] = {"mass": 0.9, "damping": 0.25}
    given = entry(question="parameters", parameter="", rivals=["nothing"], runs=[best], repeat=None)
    question, answer = proposal_lines(given)
    assert question == "To know the parameters more precisely:"
    assert "leave 25 % of the standard deviation of damping" in answer
    assert proposal_table(given).head[-2:] == ["sd of damping [%]", "sd of mass [%]"]


def test_table_lists_runs_and_the_best_one_that_was_made():
    table = proposal_table(entry())
    assert table.head[3] == "amplitude [mm]"
    assert [row[0] for row in table.rows] == ["1", "run 3 once more"]
    assert table.rows[0][1:] == ["2.00", "120", "50.0", "0.90", "8.2"]


def test_of_three_the_least_separated_pair_counts_and_an_inseparable_one_is_named():
    sigmas = {("a", "b"): 0.01, ("a", "c"): 5.0, ("b", "c"): 6.0}
    lines = proposal_lines(
        entry(
            rivals=["a", "b", "c"],
            runs=[trial(sigmas)],
            repeat=trial(dict.fromkeys(sigmas, 0.0), run="x", information=0.0),
            inseparable=[["a", "b"]],
        )
    )
    assert "is expected to tell 0.90 bits" in lines[1]
    assert "separates a from b" in lines[2]


def test_where_no_run_tells_anything_none_is_listed():
    same = entry(runs=[trial({("a", "b"): 0.1})], inseparable=[["a", "b"]])
    assert "one law in other words" in proposal_lines(same)[1]
    assert proposal_table(same) is None


def test_where_no_run_can_be_foreseen_the_reason_is_said():
    lines = proposal_lines(entry(runs=[], repeat=None, note="periodic runs only"))
    assert lines[1] == "No run can be proposed: periodic runs only."
    lines = proposal_lines(entry(runs=[], repeat=None, left_out={"an output beyond its limits": 9}))
    assert "an output beyond its limits" in lines[1]


def test_many_pairs_share_one_column():
    names = "abcd"
    sigmas = {(x, y): 3.0 for x in names for y in names if x < y}
    table = proposal_table(entry(rivals=list(names), runs=[trial(sigmas)], repeat=None))
    assert table.head[-1] == "least separated pair [σ]"
    assert len(table.rows[0]) == len(table.head)
