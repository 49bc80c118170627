"""A normal distribution, with or without gSDE, of actions that tanh squashes; its gradients in NumPy."""

import dataclasses

import numpy as np

from rlctl.training.updates.perceptrons import LOG_SQRT_TAU, Floats, MlpStack

_LOG_STD_MIN, _LOG_STD_MAX = -20.0, 2.0  # SB3's limits, without gSDE


@dataclasses.dataclass(frozen=True)
class Sample:
    """Sampled actions of a batch, and the values for their gradients; shape (batch, actions) each."""

    values: list[Floats]  # the outputs of the actor's layers
    noise: Floats  # added to the mean before tanh
    std: Floats
    action: Floats
    log_prob: Floats  # shape (batch, 1)


class SquashedGaussian:
    """The actor of SAC; `log_std` is None without gSDE, where the network's last outputs are the logarithms."""

    def __init__(
        self, network: MlpStack, log_std: Floats | None, actions: int, epsilon: float, mean_limit: float | None
    ) -> None:
        self.network, self._log_std, self._count = network, log_std, actions
        self._epsilon, self._mean_limit = np.float32(epsilon), mean_limit

    def sample(self, features: Floats, use: str, normal: Floats) -> Sample:
        """Draw actions; `normal`: standard normal numbers, or gSDE's noise matrix."""
        values = self.network.run(features[None], use)
        mean = values[-1][0, :, : self._count]
        if self._log_std is not None:
            latent = self.network.read_latent(values)[0]
            if self._mean_limit is not None:
                mean = mean.clip(-self._mean_limit, self._mean_limit)
            noise = latent @ normal
            std = np.sqrt(np.square(latent) @ np.exp(2 * self._log_std) + self._epsilon)
            log_std, z = np.log(std), noise / std
        else:
            log_std, z = values[-1][0, :, self._count :].clip(_LOG_STD_MIN, _LOG_STD_MAX), normal
            std = np.exp(log_std)
            noise = std * z
        action = np.tanh(mean + noise)
        log_prob = np.square(z)
        log_prob *= -0.5
        log_prob -= log_std
        log_prob -= np.log(1 - np.square(action) + self._epsilon)
        log_prob -= np.float32(LOG_SQRT_TAU)
        return Sample(values, noise, std, action, log_prob.sum(1, keepdims=True))

    def backpropagate(
        self, sample: Sample, normal: Floats, to_action: Floats, to_log_prob: float, gradients: list[Floats]
    ) -> None:
        """Set the gradients of the parameters from those of sampled actions and of their log-probabilities."""
        slope = 1 - np.square(sample.action)
        to_mean = to_action * slope + sample.action * slope / (slope + self._epsilon) * np.float32(2 * to_log_prob)
        outputs = sample.values[-1][0]
        if self._log_std is not None:
            to_latent = self._backpropagate_gsde(sample, normal, to_mean, to_log_prob, gradients.pop())
            if self._mean_limit is not None:
                to_mean = to_mean * (np.abs(outputs) < self._mean_limit)
            self.network.backpropagate(sample.values, to_mean[None], gradients, latent=to_latent[None])
            return
        log_std = outputs[:, self._count :]
        within = (log_std >= _LOG_STD_MIN) & (log_std <= _LOG_STD_MAX)
        to_log_std = (to_mean * sample.noise - np.float32(to_log_prob)) * within
        self.network.backpropagate(sample.values, np.concatenate([to_mean, to_log_std], 1)[None], gradients)

    def _backpropagate_gsde(
        self, sample: Sample, matrix: Floats, to_mean: Floats, to_log_prob: float, to_log_std: Floats
    ) -> Floats:
        """Set the gradient of `log_std`, and return that of the latent values."""
        # noise = latent @ matrix, where matrix = exp(log_std) * normal numbers, and
        # std^2 = latent^2 @ exp(2 log_std) + epsilon.
        assert self._log_std is not None
        latent, variances = self.network.read_latent(sample.values)[0], np.exp(2 * self._log_std)
        precision = np.reciprocal(np.square(sample.std))
        to_noise = to_mean - sample.noise * precision * np.float32(to_log_prob)
        to_variance = (np.square(sample.noise) * precision - 1) * precision * np.float32(0.5 * to_log_prob)
        np.multiply(latent.T @ to_noise, matrix, out=to_log_std)
        to_log_std += (np.square(latent).T @ to_variance) * variances * 2
        to_latent: Floats = to_noise @ matrix.T + latent * (to_variance @ variances.T) * 2
        return to_latent
