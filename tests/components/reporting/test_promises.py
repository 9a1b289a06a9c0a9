"""What is said in plain words of policies that were judged from a log alone."""

import pytest

from components.reporting.judged import JudgedLog, Returns
from components.reporting.judged_page import judged_content, judged_data, judged_page
from components.reporting.promises import Promise, brief, promise
from tests.components.reporting.judged import NAN, TIMID, Rows, found, judged, log, without_ensemble


def words(told: Promise) -> str:
    return " ".join([told.headline, *told.sentences, *told.warnings, *told.first])


def of(**given: Rows) -> Promise:
    return promise(log(given))


def dial(*points: tuple[float, float, float, float]) -> Promise:
    return of(lion=points)


def test_choices_stand_for_all_seeds_and_name_the_best_one() -> None:
    best = found({"td3_bc": TIMID["td3_bc"]})[0]
    assert (best.name, best.policies, best.run) == ("td3_bc", 2, "td3_bc/timid/seed0")
    assert best.expected.value == pytest.approx(16.0)
    # Two policies of errors 0.6 that lie 1 apart, and the behaviour's 0.8.
    assert best.expected.error == pytest.approx((((0.36 + 0.5) / 2) + 0.64) ** 0.5)
    assert best.sceptical == pytest.approx(15.0)
    assert best.promised is None


def test_a_trial_begins_at_the_smallest_hopeful_lambda() -> None:
    told = promise(log())
    assert (told.judgement, told.headline) == ("gain", "Worth a careful trial")
    assert "the judge would choose td3_bc. It is expected to return 16.0 ± 1.0 more" in words(told)
    assert "23% of the -70.0 in the log, in the mean of its 2 policies." in words(told)
    assert "trained once" not in words(told)
    assert told.first[0].startswith("Begin with lion at λ 0.10, the smallest judged λ")
    assert "td3_bc scores best, but has no λ" in told.first[1]
    assert told.first[2] == "With lion the judge would go no further."
    assert told.run == "lion/timid/seed0"
    [differ, tempting] = told.warnings
    assert differ.startswith("The judges differ on td3_bc by more than their errors")
    assert tempting.startswith("Do not be tempted by lion at λ 1.00: +27.0 is promised, but 100%")


def test_lambda_is_raised_no_further_than_the_judge_would() -> None:
    told = dial((0.0, -2, -1, 0.01), (0.1, 3, 3, 0.01), (0.4, 9, 9, 0.02), (1.0, 10, 10, 0.9))
    assert told.first[0].startswith("Begin with lion at λ 0.10,")
    assert told.first[1].endswith("the judge would not go beyond λ 0.40.")
    told = dial((0.1, 3, 3, 0.01))
    assert told.first[1] == "With lion the judge would go no further."


def test_lambda_0_counts_and_what_leaves_the_log_is_no_beginning() -> None:
    """As on a tank, whose λ = 0.1 drove the level far out of the log."""
    told = dial((0.0, 4, 5, 0.24), (0.1, 7, 8, 0.54), (0.2, 10, 10, 0.78), (1.0, 150, 150, 1.0))
    assert told.first[0].startswith("Begin with lion at λ 0.00, the smallest judged λ at which all")
    assert "at λ 0.10 already 54% of the steps lie outside" in told.first[1]
    assert told.first[1].endswith("and the judge would not go beyond λ 1.00.")
    assert told.run == "lion/timid/seed0"


def test_a_familiar_lambda_is_preferred_and_said_to_be_so() -> None:
    told = dial((0.0, 4, 5, 0.30), (0.1, 7, 8, 0.10), (0.2, 30, 30, 0.78))
    assert told.first[0].startswith("Begin with lion at λ 0.10,")
    assert "expect a gain and less than a quarter of the steps lie outside" in told.first[0]


def test_a_beginning_without_a_gain_is_better_than_one_outside_of_the_log() -> None:
    told = dial((0.0, -1, 0.5, 0.05), (0.1, 7, 8, 0.54), (0.2, 80, 80, 0.78))
    assert told.first[0].startswith("Begin with lion at λ 0.00,")
    assert "no judge expects a loss that is more than chance" in told.first[0]
    assert told.first[1].startswith("Where all judges expect a gain, a quarter of the steps")


@pytest.mark.parametrize("zero", [(0.0, 4, 5, 0.26), (0.0, -9, -9, 0.05)])
def test_where_no_lambda_is_promising_and_familiar_that_is_said(
    zero: tuple[float, float, float, float],
) -> None:
    points = zero, (0.1, 7.0, 8.0, 0.54), (0.2, 80.0, 80.0, 0.78)
    told = dial(*points)
    least = "26%" if zero[1] > 0 else "54%"
    assert told.first[0] == (
        "No judged λ of lion is both promising and familiar: where all judges expect a gain, "
        f"{least} of the steps or more lie outside of what the log has seen."
    )
    assert told.first[1].startswith("Begin with the logged behaviour")
    assert ("lion at λ 0.00, which is to imitate it" in told.first[1]) == (zero[1] > 0)
    assert bool(told.run) == (zero[1] > 0), "a λ 0 that loses is no beginning"
    beside = of(lion=points, bc=[(NAN, 2, 2, 0.03)])
    assert beside.first[0] == told.first[0]
    assert beside.first[1].startswith("Try bc (the ensemble +2.0")
    assert beside.run == "bc/timid/seed0"


def test_a_fixed_policy_outside_of_the_log_is_not_tried() -> None:
    told = of(td3_bc=[(NAN, 90, 90, 0.9)])
    assert told.first[0].startswith("td3_bc is promising, but not familiar (the ensemble +90.0")
    assert told.first[1] == "Begin with the logged behaviour: leave the plant as it is."
    assert told.run == ""


def test_the_first_guess_of_a_ranking_stands_beside_the_judges() -> None:
    ranked = promise(log(guess=(0.0, 0.05)))
    assert ranked.first[:-1] == promise(log()).first
    assert ranked.first[-1].startswith("How much the log explores lets one guess a λ of 0.00 to 0.")
    assert "0.00 and no more at first" in promise(log(guess=(0.0, 0.0))).first[-1]


@pytest.mark.parametrize(
    ("point", "judgement", "headline", "warning"),
    [
        ((0.5, 30, 30, 0.25), "unsure", "A promise from outside of the log", "25% of the steps"),
        ((0.5, 9, -4, 0.01), "unsure", "The judges contradict each other", "ensemble +9.0 ± 1.0"),
        ((0.5, 1.5, 9, 0.01), "unsure", "A gain that may be chance", "differ on lion"),
        ((0.5, 9, 9, 0.24), "gain", "Worth a careful trial", ""),
        ((0.5, -1, 9, 0.01), "none", "Leave it as it is", ""),
        ((0.5, 9, 9, 0.90), "none", "Leave it as it is", ""),
    ],
)
def test_what_speaks_against_a_trial_is_said(
    point: tuple[float, float, float, float], judgement: str, headline: str, warning: str
) -> None:
    told = dial(point)
    assert (told.judgement, told.headline) == (judgement, headline)
    assert warning in " ".join(told.warnings)
    assert bool(told.warnings) == bool(warning)


def test_a_fixed_policy_can_only_be_switched_off() -> None:
    told = of(td3_bc=TIMID["td3_bc"])
    assert "can only be switched off" in told.first[0]
    assert told.run == "td3_bc/timid/seed0"


def test_where_judges_disagree_nothing_is_tried() -> None:
    for point in ((NAN, 9, -4, 0.01), (0.5, 9, -4, 0.01)):
        told = dial(point)
        assert told.first[0].startswith("Nothing yet: the judges do not agree that lion")
        assert told.run == ""
    assert "from λ 0, which does what was always done" in told.first[1]


def test_opposed_orders_of_the_judges_are_said() -> None:
    points = [(0.1 * n, float(n), 9.0 - n, 0.01) for n in range(1, 5)]
    assert "their orders are opposed (Spearman's correlation -1.00)" in words(dial(*points))
    assert "opposed" not in words(dial(*points[:3])), "of three choices an order says little"


def test_judges_that_do_not_know_the_log_advise_nothing() -> None:
    told = promise(log(doubts=["timid: do not trust the gains there."]))
    assert (told.judgement, told.headline) == ("unsure", "The judges do not know this plant")
    assert told.warnings[0] == "timid: do not trust the gains there."
    assert told.first[0].startswith("Nothing yet")
    assert told.run == ""


def test_critics_judge_alone_where_there_is_no_ensemble() -> None:
    told = promise(without_ensemble())
    assert "12.0 ± 1.0 more than the logged behaviour" in words(told)
    assert "No ensemble was fitted to this log" in words(told)
    assert "least favourable" not in words(told)


def test_what_is_unfinished_or_has_diverged_is_said() -> None:
    told = promise(log(choices=[], progress=["Not finished: bc."]))
    assert (told.judgement, told.sentences) == ("unknown", ["Not finished: bc."])
    told = promise(log({"lion": [(0.5, NAN, NAN, 0.01)]}))
    assert (told.judgement, told.headline) == ("unknown", "No judgement")


@pytest.mark.parametrize(
    ("size", "says"), [(7e6, "return 2,000,000 ±"), (0.0007, "return 0.000200 ±")]
)
def test_numbers_are_as_long_as_the_logs_returns_need(size: float, says: str) -> None:
    rows = {"td3_bc": [(NAN, 2 / 7 * size, 2 / 7 * size, 0.01)]}
    assert says in words(promise(log(rows, returns=Returns(-size, -size, -size))))


def test_what_is_not_finite_is_null_for_the_script() -> None:
    [data] = judged_data([log({"lion": [(0.5, NAN, float("-inf"), 0.01)]})])
    [curve] = data["curves"]
    assert curve["points"][0]["critics"][0] is None
    waiting: JudgedLog = log(choices=[])
    [data] = judged_data([waiting])
    assert (data["best"], data["curves"]) == (None, [])
    assert judged_content([waiting])[0]["table"] is None


def test_text_of_users_stays_text() -> None:
    evil = "</script><img src=x onerror=alert(1)>"
    hostile = log(name=evil, facts={evil: evil}, doubts=[evil], progress=[evil])
    text = judged_page(judged(logs=[hostile], sweeps={evil: evil}, notes=[evil], budget=evil))
    assert "<img" not in text
    assert text.count("&lt;img src=x onerror=alert(1)&gt;") > 8


def test_a_terminal_gets_the_headline_and_the_beginning() -> None:
    doubted = log(doubts=["timid: do not trust the gains there."])
    for given, warned in ((log(), bool(promise(log()).warnings)), (doubted, True)):
        head, first, *others = brief(given)
        said = promise(given)
        assert said.headline in head
        assert first == f"What to try first. {' '.join(said.first)}"
        assert others == ["The page says what speaks against it."] * warned
    [head] = brief(log(choices=[]))
    assert "Not judged yet" in head
