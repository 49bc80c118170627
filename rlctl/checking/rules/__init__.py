'''The rules of check-env, a file each: text, severity, the code that judges it, and what that needs.

To add a rule, write `rl1xx_what_is_wrong.py` here, whose name begins with the id. No list has to name it.

    RULE = Rule("RL1xx", "what is wrong", Severity.WARNING, meaning="""...""", fix="""...""")

Its code is one of these, or several, but of each decorator one at most:

    @judges_records(RULE, "episodes")       # in the parent, from what experiments recorded; by default RECORDING
    def find_both_flags(records: Records) -> Iterator[RuleFinding]:
        yield RuleFinding(RULE, message, evidence)

    @judges_worlds(RULE)                    # its part of a shared experiment: a hook of `rlctl.checking.experiments`
    def find_no_gravity(watched: WatchedWorlds) -> Iterator[ChildMessage]: ...

    @experiment("rendering", INSTANCES, 100, RULE)    # of its own, in a child process: name, process, place in it
    def render(context: Context) -> Iterator[ChildMessage]: ...

`raise NotJudged(why)` or `NotApplicable(why)` ends a judge or an experiment, and applies to all its rules without a
finding; `yield Skipped(RULE.id, why)` in an experiment applies to one. An experiment calls the environment only through
`Instance.call`, `Instance.reset` and `EpisodePlayer`: its exceptions are then `EnvironmentRaised`, which need not be
caught, and hangs and crashes can be located. `context.budget` limits time and memory. An experiment that records
episodes yields what `Recording.run()` returns. A finding has its own severity or fix only if they differ.

Write a class that makes the mistake, `RL1xxSomeName`, and one that does not in `tests/checking/`, a `case` of both, and
then the rule's page: `python docs/make_rules.py --run RL1xx`.
'''
