"""Environments with one mistake each in their reward, or in what they call success."""

import numpy as np
from broken_envs import Clean


class RL602ConstantReward(Clean):
    def reward(self):
        return 1.0


class RL602SparseNeverFound(Clean):
    """-1 per step; its goal is too far for any search, so is_success cannot be told apart from a broken one."""

    def reward(self):
        return -1.0

    def info(self):
        return {"is_success": bool(self.position[0] > 4.9)}


class RL603LargeReward(Clean):
    def reward(self):
        return 100.0 * super().reward()


class RL603LargeTerm(Clean):
    """A term is in millimetres."""

    def reward(self):
        return sum(self.terms().values())

    def terms(self):
        return {"distance": 1000.0 * super().reward(), "bonus": 1.0}

    def info(self):
        return {**super().info(), "reward_terms": self.terms()}


class RL603HugeOnce(Clean):
    def reward(self):
        return super().reward() - 5000.0 * (self.steps == 20)


class RL603FinalBonus(Clean):
    """A large bonus at the end: nothing is wrong with it."""

    def reward(self):
        return super().reward() + 100.0 * self.is_truncated()


class RL604Falls(Clean):
    """Ends outside of a square; the reward is negative everywhere."""

    fall = 0.0

    def has_fallen(self):
        return bool(np.abs(self.position).max() > 1.5)

    def is_terminated(self):
        return self.has_fallen()

    def reward(self):
        return super().reward() - self.fall * self.has_fallen()


class RL604FallsBadly(RL604Falls):
    """The same with a penalty that outweighs all steps to come."""

    fall = 200.0


class RL604FallsUntold(RL604Falls):
    """Success is not told."""

    def info(self):
        return {}


class EndsAtUntoldGoal(Clean):
    """Its goal ends the episode, and it does not say that this is success."""

    def is_terminated(self):
        return bool(np.linalg.norm(self.position) < 0.1)

    def info(self):
        return {}


class RL605Hovering(Clean):
    """+10 per step within 0.4 of the goal; the episode ends within 0.1."""

    bonus = 0.0

    def distance(self):
        return float(np.linalg.norm(self.position))

    def is_terminated(self):
        return self.distance() < 0.1

    def reward(self):
        return -self.distance() + 10.0 * (self.distance() < 0.4) + self.bonus * (self.distance() < 0.1)


class RL605HoveringUntold(RL605Hovering):
    """The same, without is_success, and with a bonus that is too small."""

    bonus = 5.0

    def info(self):
        return {}


class RL605FinishingPays(RL605Hovering):
    """The same with a bonus for finishing that outweighs hovering."""

    bonus = 500.0


class RL605PaysProgress(RL605Hovering):
    """Pays for coming nearer: nothing is to be earned by staying."""

    def start(self):
        super().start()
        self.last = self.distance()

    def reward(self):
        progress, self.last = self.last - self.distance(), self.distance()
        return 10.0 * progress


class Terms(Clean):
    """A reward of three terms, told in info: nothing is wrong with it."""

    def reward(self):
        return sum(self.terms().values())

    def terms(self):
        distance = float(np.linalg.norm(self.position))
        return {"distance": -distance, "near": float(np.exp(-distance)), "effort": self.effort()}

    def effort(self):
        return -0.05 * float(np.square(self.action).sum())

    def start(self):
        super().start()
        self.action = np.zeros(2)

    def move(self, action):
        super().move(action)
        self.action = action

    def info(self):
        return {**super().info(), "reward_terms": self.terms()}


class SparseTerm(Terms):
    """A term that is 0 in all that is tried may be a bonus for what was not found."""

    def terms(self):
        return {"distance": -float(np.linalg.norm(self.position)), "far": float(self.position[0] > 4.9)}


class RL612WrongSlice(Terms):
    """The effort is computed from something that never changes."""

    def effort(self):
        return -0.05 * self.size


class RL612TimePenalty(Terms):
    def terms(self):
        return {**super().terms(), "time": -0.01}


class RL620Smooth(Terms):
    """A term for the change of the action; nothing is wrong with it."""

    def start(self):
        super().start()
        self.last = np.zeros(2)

    def move(self, action):
        self.last = self.action
        super().move(action)

    def terms(self):
        return {**super().terms(), "smoothness": -0.1 * float(np.square(self.action - self.last).sum())}


class RL620ActionWithItself(RL620Smooth):
    def move(self, action):
        super().move(action)
        self.last = self.action


class RL620WeightInAnAttribute(RL620ActionWithItself):
    weights = {"rate": 0.2}

    def terms(self):
        change = float(np.square(self.action - self.last).sum())
        terms = super().terms()
        terms["smoothness"] = -self.weights["rate"] * change
        return terms


class RL620WeightInAMethod(RL620ActionWithItself):
    weight = 0.3

    def change(self):
        return -self.weight * np.square(self.action - self.last).sum()

    def terms(self):
        return {**super().terms(), "smoothness": float(self.change())}


class RL620WeightOfZero(RL620WeightInAMethod):
    """It may be meant to cost nothing."""

    weight = 0.0


class RL621EffortPays(Terms):
    """The minus is there twice."""

    def effort(self):
        return -super().effort()


class RL621CalledPenalty(Terms):
    def terms(self):
        return {**super().terms(), "border_penalty": float(np.abs(self.position).max())}


class RL621LowersTheReward(Terms):
    def terms(self):
        return {**super().terms(), "border_penalty": -float(np.abs(self.position).max())}


class RL606AliveBonus(Terms):
    """A bonus per step beside a term for speed that can hardly be had, and a cost of moving."""

    rlctl_ignore = {"RL621": "it is paid for moving, by so little"}

    def terms(self):
        return {"alive": 1.0, "speed": 0.02 * float(np.abs(self.action).sum()), "effort": 5 * self.effort()}


class RL606AliveUntold(RL606AliveBonus):
    def info(self):
        return Clean.info(self)


class RL606Paid(RL606AliveBonus):
    """A speed that pays more than the bonus."""

    def terms(self):
        return {**super().terms(), "speed": float(np.abs(self.action).sum())}


class RL609SuccessUntold(Clean):
    def info(self):
        return {}


class RL609SuccessMisnamed(Clean):
    def info(self):
        return {"goal_reached": bool(np.linalg.norm(self.position) < 0.1)}


class Succeeds(Clean):
    """The name of gym-hil, whose numbers no tool takes for a success."""

    def info(self):
        return {"succeed": bool(np.linalg.norm(self.position) < 0.1)}


class RL609SuccessOtherwiseNamed(Clean):
    """The name and the numbers of Adroit and Meta-World count too."""

    def info(self):
        return {"success": float(np.linalg.norm(self.position) < 0.1)}


class RL609SuccessIsAShare(Clean):
    """A `success` that is no flag means something else."""

    def info(self):
        return {"success": 0.37}


class RL609SuccessArray(Clean):
    """An array without axes is a number too."""

    def info(self):
        return {"is_success": np.array(np.linalg.norm(self.position) < 0.1)}


class RL610SuccessAtStart(Clean):
    def info(self):
        return {"is_success": bool(np.linalg.norm(self.position) < 1.0)}


class RL610SuccessOnAverage(Clean):
    """Success is about the mean distance of the episode so far, which grows if nothing is done."""

    def reset(self, **kwargs):
        self.distances = []
        return super().reset(**kwargs)

    def info(self):
        self.distances.append(float(np.linalg.norm(self.position)) + 0.04 * self.steps)
        return {"is_success": bool(np.mean(self.distances) < 1.0)}


class RL611SuccessNever(Clean):
    """Success is a reward that cannot be reached."""

    def info(self):
        return {"is_success": self.reward() > 0.1}
