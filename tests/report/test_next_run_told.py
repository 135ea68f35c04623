"""What is said of the run to make next."""

from __future__ import annotations

from bayesoleo._report.sentences import proposal_lines, proposal_table


def trial(sigmas, amplitude=0.05, run=None):
    pairs = [{"rivals": list(pair), "sigma": sigma} for pair, sigma in sigmas.items()]
    entry = {
        "frequency": 2.0,
        "mean": 0.12,
        "amplitude": amplitude,
        "information": 0.9,
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
        "repeat": trial({("a", "b"): 0.4}, 0.02, "run 3"),
        "inseparable": [],
        "left_out": {},
        "note": "",
    }
    return given | changed


def test_two_rivals_are_told_with_the_run_in_an_engineers_units():
    question, answer = proposal_lines(entry())
    assert question == "These data cannot tell a, which was added, from b."
    assert "2.00 Hz, mean 120 mm, amplitude 50.0 mm would separate a from b by 8.2 " in answer
    assert "no present run, made once more, by more than 0.4." in answer


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
            repeat=trial(dict.fromkeys(sigmas, 0.0), run="x"),
            inseparable=[["a", "b"]],
        )
    )
    assert "would separate the others by at least 5.0" in lines[1]
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
