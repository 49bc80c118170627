"""The verdict from what competitors earned, with numbers that can be followed by hand."""

import dataclasses

import pytest

from rlctl.checking.audit.play_world import PlayedEpisode
from rlctl.checking.audit.ranking import Ranking, rank

FOLLOWING, STANDING, HALF = "following the command", "standing still", "half of the commanded speed"


def episode(name, terms, *, success=False, steps=100, seed=0, discounted=None):
    total = float(sum(terms.values()))
    return PlayedEpisode(name, seed, steps, total, total if discounted is None else discounted, terms, success, False)


def judge(*episodes, has_success=True) -> Ranking:
    return rank(episodes, has_success)


def test_standing_is_paid_by_being_alive():
    # 94 of 100: both are alive, and following adds 6.
    following = episode(FOLLOWING, {"alive": 90.0, "tracking": 10.0}, success=True)
    standing = episode(STANDING, {"alive": 90.0, "tracking": 4.0})
    (first,) = judge(following, standing).beaten
    assert first.describe() == "standing still earns 94 % of following the command; alive pays it"


def test_less_than_nine_tenths_is_sound():
    following = episode(FOLLOWING, {"alive": 50.0, "tracking": 50.0}, success=True)
    assert not judge(following, episode(STANDING, {"alive": 50.0, "tracking": 39.0})).beaten


def test_half_of_the_speed_may_earn_nearly_as_much_and_not_as_much():
    following = episode(FOLLOWING, {"tracking": 100.0}, success=True)
    assert not judge(following, episode(HALF, {"tracking": 95.0})).beaten
    assert judge(following, episode(HALF, {"tracking": 100.0})).beaten[0].term == "tracking"


def test_falling_saves_the_cost_of_a_term():
    # Following costs 40 more than it pays; a fall ends that.
    following = episode(FOLLOWING, {"tracking": 10.0, "torque": -50.0}, success=True)
    falling = episode("falling at once", {"tracking": 0.0, "torque": -1.0}, steps=1)
    text = judge(following, falling).beaten[0].describe()
    assert text == "falling at once earns more than following the command (-1 against -40); it saves the cost of torque"


def test_what_a_competitor_does_is_named_before_what_all_get():
    following = episode(FOLLOWING, {"alive": 100.0, "steps": 0.0, "tracking": 20.0}, success=True)
    stepping = episode("stepping in place", {"alive": 100.0, "steps": 15.0, "tracking": 0.0})
    standing = episode(STANDING, {"alive": 100.0, "steps": 0.0, "tracking": 0.0})
    found = {one.competitor: one.term for one in judge(following, stepping, standing).beaten}
    assert found == {"stepping in place": "steps"}


def test_of_two_that_earn_as_much_the_simple_one_is_named_first():
    following = episode(FOLLOWING, {"alive": 100.0}, success=True)
    drifting = episode("drifting", {"alive": 98.0})
    standing = episode(STANDING, {"alive": 96.0})
    assert [one.competitor for one in judge(following, drifting, standing).beaten] == [STANDING, "drifting"]


def test_a_competitor_that_succeeds_is_none():
    following = episode(FOLLOWING, {"alive": 100.0}, success=True)
    assert not judge(following, episode(STANDING, {"alive": 100.0}, success=True)).beaten


def test_the_discounted_return_has_to_be_as_much_too():
    following = episode(FOLLOWING, {"bonus": 100.0}, success=True, discounted=90.0)
    assert not judge(following, episode("falling at once", {"bonus": 100.0}, discounted=40.0)).beaten


def test_only_episodes_that_both_have_played_are_compared():
    following = [episode(FOLLOWING, {"alive": value}, success=True, seed=i) for i, value in enumerate((100.0, 10.0))]
    assert not judge(*following, episode(STANDING, {"alive": 60.0}, seed=0)).beaten


@pytest.mark.parametrize("success", [True, False])
def test_a_play_that_is_no_success_is_not_what_is_wanted(success):
    ranking = judge(episode(FOLLOWING, {"alive": 1.0}, success=success), episode(STANDING, {"alive": 1.0}))
    assert bool(ranking.wanted) is success
    assert bool(ranking.why_alone) is not success


def test_the_policy_that_acts_is_wanted_before_the_base_that_is_moved():
    shipped = episode("the shipped policy", {"tracking": 80.0}, success=True)
    assert judge(shipped, episode(FOLLOWING, {"tracking": 100.0}, success=True)).wanted == "the shipped policy"


def test_a_policy_has_learned_what_its_terms_are_nearest_to():
    plays = [
        episode(FOLLOWING, {"alive": 90.0, "tracking": 90.0}, success=True),
        episode(STANDING, {"alive": 90.0, "tracking": 10.0}),
        episode("falling at once", {"alive": 1.0, "tracking": 0.0}, steps=1),
    ]
    stands = judge(*plays, episode("the learned policy", {"alive": 90.0, "tracking": 12.0}))
    assert stands.learned.startswith("it has learned to stand (return 102, following the command 180")
    walks = judge(*plays, episode("the learned policy", {"alive": 90.0, "tracking": 80.0}, success=True))
    assert walks.learned.startswith("it has learned what is wanted")


def test_a_policy_like_nobody_is_not_called_after_a_competitor():
    plays = [episode("doing nothing", {"tracking": 1.0}), episode("trembling", {"tracking": -20.0})]
    found = judge(*plays, episode("the learned policy", {"tracking": 80.0}), has_success=False).learned
    assert found.startswith("what it has learned is like no competitor (return 80")


def test_digits_that_do_not_matter_are_left_out():
    following = episode(FOLLOWING, {"torque": -8.533}, success=True)
    falling = episode("falling at once", {"torque": -1.681e-05}, steps=1)
    assert "(0 against -8.533)" in judge(following, falling).beaten[0].describe()


def test_who_is_moved_without_effort_is_compared_with_who_is_moved_as_wanted():
    # The policy's effort costs 40. The base that is moved pays nothing, at any speed.
    shipped = episode("the shipped policy", {"tracking": 100.0, "effort": -40.0}, success=True)
    following = episode(FOLLOWING, {"tracking": 100.0, "effort": 0.0}, success=True)
    half = episode(HALF, {"tracking": 80.0, "effort": 0.0})
    nothing = episode("doing nothing", {"tracking": 58.0, "effort": 0.0})
    found = judge(shipped, following, half, nothing)
    assert [(one.competitor, one.wanted) for one in found.beaten] == [("doing nothing", "the shipped policy")]


def test_costs_that_who_is_held_saves_do_not_count():
    # A statue takes no torque: without the 400 that it saves it earns 600 of 1,000.
    shipped = episode("the shipped policy", {"alive": 1000.0, "progress": 400.0, "torque": -400.0}, success=True)
    statue = episode(STANDING, {"alive": 1000.0, "progress": 0.0, "torque": 0.0})
    weak = episode("trembling", {"alive": 140.0, "progress": 0.0, "torque": 0.0})
    sound = judge(shipped, statue, weak)
    assert not sound.beaten
    assert sound.next_best == "; next is trembling with 14 %"
    nothing = episode("doing nothing", {"alive": 1000.0, "progress": 0.0, "torque": 0.0})
    assert judge(shipped, nothing).beaten[0].competitor == "doing nothing"


def test_success_that_ends_an_income_is_named_where_nobody_shows_what_is_wanted():
    trembling = episode("trembling", {}, success=True, steps=55)
    trembling = dataclasses.replace(trembling, reward=28.0, discounted=22.0)
    nothing = dataclasses.replace(episode("doing nothing", {}, steps=150), reward=85.0, discounted=44.0)
    sentence = "success does not pay: trembling succeeds in 100% of its episodes and earns 28, doing nothing never does"
    assert f"; {sentence} and earns 85" in judge(trembling, nothing).why_alone
    cheap = dataclasses.replace(nothing, reward=25.0, discounted=13.0)
    assert "success does not pay" not in judge(trembling, cheap).why_alone


def test_terms_for_steps_that_pay_one_who_stands_are_named():
    # 40 in 100 steps against 100 in 200 steps: 0.4 of 0.5 in each step. What feet in contact earn is no such term.
    following = episode(FOLLOWING, {"feet_clearance": 100.0, "feet_contact": 50.0}, success=True, steps=200)
    standing = episode(STANDING, {"feet_clearance": 40.0, "feet_contact": 50.0})
    (sentence,) = judge(following, standing).paid_still
    what = "feet_clearance pays standing still 80 % of what it pays following the command"
    assert sentence == f"{what}: it should pay nothing then"
    assert not judge(following, episode(STANDING, {"feet_clearance": 5.0, "feet_contact": 50.0})).paid_still
