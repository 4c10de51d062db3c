"""Scores agree with VNN-COMP's rules, restated here plainly, and contradictions are shown."""

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.catalogue import Reference
from harness.records import Verdict, WitnessOutcome
from harness.scoring import Claim, Conflict, score

SAT, UNSAT, UNKNOWN, TIMEOUT, ERROR = (
    Verdict(x) for x in ["sat", "unsat", "unknown", "timeout", "error"]
)
STRICT, LOOSE, WRONG = (
    WitnessOutcome.CORRECT,
    WitnessOutcome.CORRECT_WITH_TOLERANCE,
    WitnessOutcome.WRONG,
)


def claim(tool, verdict, witness=None, instance="i", category="c", run_time=1.0, timeout=10.0):
    if verdict is not SAT:
        witness = None
    return Claim(tool, category, instance, verdict, run_time, timeout, witness)


def points(claims, references=None):
    judgements = score(claims, references or {}).judgements
    return {(j.claim.tool, j.claim.instance): j.points for j in judgements}


# --- VNN-COMP's rules, once more, in their own words -----------------------------------------


def vnncomp(claims, references):
    """Return ({(tool, instance): points}, {(tool, category): percent}, {tool: total percent})."""
    rows = []
    for c in claims:
        result = {SAT: "violated", UNSAT: "holds"}.get(c.verdict, "nothing")
        if c.run_time > c.timeout:
            result = "nothing"
        rows.append((c.tool, c.category, c.instance, result, c.witness))

    awarded = {}
    for tool, _, instance, result, witness in rows:
        valid_ce_any_tool = False
        for _, _, other_instance, other_result, other_witness in rows:
            if other_instance == instance and other_result == "violated":
                valid_ce_any_tool |= other_witness == "correct"
        # Ours: the reference result is one more participant, with evidence or without.
        reference = references.get(instance)
        if reference and reference.verdict == "sat":
            valid_ce_any_tool |= reference.margin_upper is not None and reference.margin_upper <= 0
        valid_ce_this_tool = witness in ("correct", "correct_with_tolerance")
        # Theirs: a witness that the judges cannot judge is nobody's fault.
        unsupported = result == "violated" and witness == "unsupported"
        if result == "nothing" or unsupported:
            awarded[tool, instance] = 0
        elif (result == "violated" and not valid_ce_this_tool) or (
            result == "holds" and valid_ce_any_tool
        ):
            awarded[tool, instance] = -150
        else:
            awarded[tool, instance] = 10

    category_score = Counter()
    for tool, category, instance, _, _ in rows:
        category_score[tool, category] += awarded[tool, instance]
    percents, totals = {}, Counter()
    for tool, category in category_score:
        max_score = max(s for (_, other), s in category_score.items() if other == category)
        percent = 0.0
        if max_score > 0:
            percent = max(0, 100 * category_score[tool, category] / max_score)
        percents[tool, category] = percent
        totals[tool] += percent
    return awarded, percents, totals


@st.composite
def contests(draw):
    tools = draw(st.lists(st.sampled_from("ABCD"), min_size=1, unique=True))
    claims, references = [], {}
    for category in draw(st.lists(st.sampled_from(["x", "y", "z"]), min_size=1, unique=True)):
        for number in range(draw(st.integers(1, 4))):
            instance = f"{category}{number}"
            for tool in tools:
                if draw(st.integers(0, 5)) == 0:
                    continue  # not run
                claims.append(
                    claim(
                        tool,
                        draw(st.sampled_from(Verdict)),
                        draw(st.none() | st.sampled_from(WitnessOutcome)),
                        instance,
                        category,
                        draw(st.sampled_from([0.5, 10.0, 10.01])),
                    )
                )
            if draw(st.booleans()):
                references[instance] = Reference(
                    draw(st.sampled_from([SAT, UNSAT, UNKNOWN])),
                    draw(st.none() | st.sampled_from([-0.1, 0.1])),
                    draw(st.none() | st.sampled_from([-0.1, 0.0, 1e-5, 0.1])),
                )
    return claims, references


@settings(max_examples=150, deadline=None)
@given(contests())
def test_agrees_with_vnncomp(contest):
    claims, references = contest
    awarded, percents, totals = vnncomp(claims, references)
    scores = score(claims, references)
    assert {(j.claim.tool, j.claim.instance): j.points for j in scores.judgements} == awarded
    rows = {(row.tool, row.category): row for row in scores.rows}
    assert {key for key in rows if key[1] != "overall"} == set(percents)
    for key, percent in percents.items():
        assert rows[key].percent == pytest.approx(percent)
    for tool, total in totals.items():
        assert rows[tool, "overall"].percent == pytest.approx(total)


def par2(claims, tool, category):
    """Return the mean of run times, twice the limit (the largest given) for what is not solved."""
    awarded, _, _ = vnncomp(claims, {})
    times = []
    for instance in {c.instance for c in claims if category in ("overall", c.category)}:
        limit = max(c.timeout for c in claims if c.instance == instance)
        mine = [c for c in claims if (c.tool, c.instance) == (tool, instance)]
        solved = mine and awarded[tool, instance] > 0
        times.append(mine[0].run_time if solved else 2 * limit)
    return sum(times) / len(times)


def solved_alone(claims, tool, category):
    awarded, _, _ = vnncomp(claims, {})
    in_category = {c.instance for c in claims if c.category == category}
    solved = {i for i in in_category if awarded.get((tool, i), 0) > 0}
    others = {i for (other, i), points in awarded.items() if other != tool and points > 0}
    takes_part = len({c.tool for c in claims if c.category == category}) > 1
    return sorted(solved - others) if takes_part else []


@settings(max_examples=60, deadline=None)
@given(contests())
def test_par2_and_unique_solves(contest):
    claims, _ = contest
    for row in score(claims, {}).rows:
        assert row.par2_s == pytest.approx(par2(claims, row.tool, row.category))
        categories = {c.category for c in claims} if row.category == "overall" else {row.category}
        alone = [solved_alone(claims, row.tool, category) for category in categories]
        assert sorted(row.unique) == sorted(instance for part in alone for instance in part)


@settings(max_examples=60, deadline=None)
@given(contests())
def test_counts_add_up(contest):
    claims, references = contest
    scores = score(claims, references)
    for row in scores.rows:
        counted = row.sat + row.unsat + row.incorrect + row.unknown + row.timeout + row.error
        assert counted + row.missing == row.instances
        assert row.score == 10 * (row.sat + row.unsat) - 150 * row.incorrect
        mine = [c for c in claims if c.tool == row.tool and row.category in ("overall", c.category)]
        assert counted == len(mine)
        assert 0 <= row.par2_s <= 20
    overall = [row for row in scores.rows if row.category == "overall"]
    for row in overall:
        parts = [r for r in scores.rows if r.tool == row.tool and r.category != "overall"]
        assert row.score == sum(r.score for r in parts)


@settings(max_examples=60, deadline=None)
@given(contests())
def test_disagreements_by_kind_add_up(contest):
    claims, references = contest
    scores = score(claims, references)
    assert sum(scores.by_kind().values()) == len(scores.contradictions)
    categories = {c.category for c in claims}
    for kind, count in scores.by_kind().items():
        assert count == sum(scores.by_kind(category=c)[kind] for c in categories)
    for row in scores.rows:
        assert row.incorrect == row.refuted + row.bad_witness
        category = None if row.category == "overall" else row.category
        assert row.refuted <= scores.by_kind(row.tool, category)[Conflict.REFUTED] + sum(
            r.verdict is SAT for r in references.values()
        )


@settings(max_examples=60, deadline=None)
@given(contests(), st.randoms(use_true_random=False))
def test_order_of_results_does_not_matter(contest, random):
    claims, references = contest
    shuffled = random.sample(claims, len(claims))
    a, b = score(claims, references), score(shuffled, references)
    assert points(claims, references) == points(shuffled, references)
    assert sorted(map(str, a.rows)) == sorted(map(str, b.rows))


@settings(max_examples=60, deadline=None)
@given(contests())
def test_nothing_that_is_refuted_earns_points(contest):
    claims, references = contest
    scores = score(claims, references)
    listed = {(c.instance, c.kind) for c in scores.contradictions}
    for judgement in scores.judgements:
        c = judgement.claim
        proved = any(o.instance == c.instance and o.proves_sat for o in claims)
        if proved and c.counted is UNSAT:
            assert judgement.points == -150
            assert (c.instance, Conflict.REFUTED) in listed
        reference = references.get(c.instance)
        if proved and reference and reference.verdict is UNSAT:
            assert (c.instance, Conflict.REFERENCE_REFUTED) in listed
            assert scores.reference_refuted


# --- the single rules -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("verdict", "witness", "expected"),
    [
        (SAT, STRICT, 10),
        (SAT, LOOSE, 10),
        (SAT, WRONG, -150),
        (SAT, WitnessOutcome.OUT_OF_BOX, -150),
        (SAT, WitnessOutcome.MALFORMED, -150),
        (SAT, WitnessOutcome.MISSING, -150),
        (SAT, WitnessOutcome.UNSUPPORTED, 0),
        (SAT, None, -150),
        (UNSAT, None, 10),
        (UNKNOWN, None, 0),
        (TIMEOUT, None, 0),
        (ERROR, None, 0),
    ],
)
def test_points_of_one_result(verdict, witness, expected):
    assert points([claim("A", verdict, witness)]) == {("A", "i"): expected}


def test_answer_after_the_limit_is_a_timeout():
    late = claim("A", SAT, STRICT, run_time=10.001)
    scores = score([late, claim("B", UNSAT)], {})
    assert scores.rows[0].tool == "B"
    assert (scores.rows[1].timeout, scores.rows[1].score) == (1, 0)
    assert scores.contradictions == ()  # what comes too late proves nothing here


def test_strict_witness_refutes_unsat():
    scores = score([claim("A", SAT, STRICT), claim("B", UNSAT)], {})
    assert points([claim("A", SAT, STRICT), claim("B", UNSAT)]) == {
        ("A", "i"): 10,
        ("B", "i"): -150,
    }
    (found,) = scores.contradictions
    assert (found.kind, found.sat, found.unsat) == (Conflict.REFUTED, ("A",), ("B",))


def test_tolerance_only_witness_refutes_nothing():
    claims = [claim("A", SAT, LOOSE), claim("B", UNSAT)]
    assert points(claims) == {("A", "i"): 10, ("B", "i"): 10}
    (found,) = score(claims, {}).contradictions
    assert found.kind is Conflict.UNSETTLED


def test_failed_witness_contradicts_nobody():
    claims = [claim("A", SAT, WRONG), claim("B", UNSAT)]
    assert points(claims, {"i": Reference(UNSAT, 0.1)}) == {("A", "i"): -150, ("B", "i"): 10}
    assert score(claims, {"i": Reference(UNSAT, 0.1)}).contradictions == ()


def test_reference_with_a_witness_refutes_unsat():
    references = {"i": Reference(SAT, None, -0.01)}
    assert points([claim("A", UNSAT)], references) == {("A", "i"): -150}


@pytest.mark.parametrize("upper", [None, 1e-9])
def test_reference_without_evidence_refutes_nothing(upper):
    references = {"i": Reference(SAT, None, upper)}
    assert points([claim("A", UNSAT)], references) == {("A", "i"): 10}
    (found,) = score([claim("A", UNSAT)], references).contradictions
    assert found.kind is Conflict.UNSETTLED


def test_witness_against_the_reference_is_shouted():
    references = {"i": Reference(UNSAT, 0.01)}
    claims = [claim("A", SAT, STRICT), claim("B", UNSAT)]
    assert points(claims, references) == {("A", "i"): 10, ("B", "i"): -150}
    scores = score(claims, references)
    assert scores.reference_refuted
    assert [c.kind for c in scores.contradictions] == [Conflict.REFERENCE_REFUTED, Conflict.REFUTED]
    assert "REFERENCE" in str(scores.contradictions[0])


def test_tool_called_reference_is_not_the_reference():
    claims = [claim("reference", UNSAT), claim("A", SAT, STRICT)]
    scores = score(claims, {"i": Reference(UNSAT, 0.1)})
    assert [c.unsat for c in scores.contradictions] == [("the reference result",), ("reference",)]


def test_percent_of_the_best_and_par2():
    claims = [
        claim("A", UNSAT, instance="1", run_time=2.0),
        claim("A", UNSAT, instance="2", run_time=4.0),
        claim("B", UNSAT, instance="1", run_time=1.0),
        claim("B", UNKNOWN, instance="2", run_time=3.0),
        claim("B", UNSAT, instance="3", category="d", run_time=1.0),
    ]
    rows = {(r.tool, r.category): r for r in score(claims, {}).rows}
    assert (rows["A", "c"].percent, rows["B", "c"].percent) == (100.0, 50.0)
    assert (rows["A", "c"].par2_s, rows["B", "c"].par2_s) == (3.0, 10.5)
    assert rows["A", "c"].unique == ("2",)
    assert rows["B", "c"].unique == ()
    assert ("A", "d") not in rows
    assert rows["A", "overall"].missing == 1
    assert rows["A", "overall"].par2_s == pytest.approx((2 + 4 + 20) / 3)
    assert (rows["A", "overall"].percent, rows["B", "overall"].percent) == (100.0, 150.0)


def test_category_that_nobody_scores_in_gives_no_percent():
    (row, _) = score([claim("A", UNKNOWN)], {}).rows
    assert (row.score, row.percent) == (0, 0.0)
    rows = score([claim("A", SAT, WRONG), claim("B", UNKNOWN)], {}).rows
    assert all(row.percent == 0 for row in rows)
