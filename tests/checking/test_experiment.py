"""Rules register with shared experiments."""

from rlctl.checking.experiment import INSTANCES, JudgeHook, experiment
from rlctl.checking.records import Skipped
from rlctl.checking.rule_index import RULES


def test_parts_run_by_their_places_and_then_by_their_rules():
    judges_numbers = JudgeHook[int]()

    @judges_numbers(RULES["RL816"])
    def find_second(number):
        yield Skipped("RL816", f"second {number}")

    @judges_numbers(RULES["RL119"], place=1, decides=False)
    def find_last(number):
        yield Skipped("RL119", f"last {number}")

    @judges_numbers(RULES["RL810"])
    def find_first(number):
        yield Skipped("RL810", f"first {number}")

    @experiment("numbers", INSTANCES, 5, RULES["RL001"], hooks=(judges_numbers,))
    def show_seven(context):
        yield from judges_numbers.judge(7)

    assert [message.reason for message in show_seven.run(None)] == ["first 7", "second 7", "last 7"]
    # RL119 adds a part, and its other judge decides it.
    assert show_seven.rules == ("RL001", "RL816", "RL810")
