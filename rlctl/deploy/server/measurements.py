"""Measurements of a server: latency, interventions, control error, processor time and memory."""

import collections
import os
import resource
import time
from pathlib import Path

import numpy as np

_WINDOW = 4096  # requests from which quantiles are computed


class Durations:
    """The most recent durations, for quantiles; count and sum of all."""

    def __init__(self) -> None:
        self._values: collections.deque[float] = collections.deque(maxlen=_WINDOW)
        self.count = 0
        self.sum_s = 0.0

    def add(self, seconds: float) -> None:
        """Add a duration."""
        self._values.append(seconds)
        self.count += 1
        self.sum_s += seconds

    def quantiles(self) -> dict[str, float]:
        """Return the median and the 99 % quantile of the recent durations [s]; zeros if there are none."""
        median, high = np.quantile(list(self._values) or [0.0], (0.5, 0.99)).tolist()
        return {"0.5": median, "0.99": high}


class Measurements:
    """Counts and durations of all clients together."""

    def __init__(self) -> None:
        self.inference, self.request = Durations(), Durations()
        self.errors = self.deadline_misses = self.connections = self.refused = self.policy_changes = 0
        self.control_error = float("nan")
        self.spread: float | None = None

    def format_prometheus(self, states: collections.Counter[str], interventions: collections.Counter[str]) -> str:
        """Return all measurements in Prometheus' text format, with the number of clients per state."""
        lines: list[str] = []

        def add(name: str, kind: str, text: str, *samples: tuple[str, float]) -> None:
            lines.append(f"# HELP rlctl_{name} {text}")
            lines.append(f"# TYPE rlctl_{name} {kind}")
            lines.extend(f"rlctl_{name}{labels} {value:.9g}" for labels, value in samples)

        for name, durations, text in (
            ("inference", self.inference, "Time of a policy's inference."),
            ("request", self.request, "Time from a request's arrival to its answer."),
        ):
            quantiles = [(f'{{quantile="{key}"}}', value) for key, value in durations.quantiles().items()]
            add(f"{name}_seconds", "summary", text, *quantiles)
            lines.append(f"rlctl_{name}_seconds_sum {durations.sum_s:.9g}")
            lines.append(f"rlctl_{name}_seconds_count {durations.count}")
        add("errors_total", "counter", "Requests with an invalid observation.", ("", self.errors))
        add("deadline_misses_total", "counter", "Requests longer than control_dt.", ("", self.deadline_misses))
        add("clients", "gauge", "Connected WebSocket clients.", ("", states.total() - 1))
        add("connections_total", "counter", "Connections so far.", ("", self.connections))
        add("refused_total", "counter", "Refused connections and requests.", ("", self.refused))
        add("policy_changes_total", "counter", "Replacements of the policy.", ("", self.policy_changes))
        states_now = [(f'{{state="{state}"}}', states[state]) for state in ("idle", "running", "holding", "stopped")]
        add("state", "gauge", "Clients by state.", *states_now)
        counts = [(f'{{name="{_escape(name)}"}}', count) for name, count in sorted(interventions.items())]
        add("interventions_total", "counter", "How often each limit and fault occurred.", *counts)
        add("control_error", "gauge", "Largest difference between a joint and its command.", ("", self.control_error))
        if self.spread is not None:
            add("action_spread", "gauge", "Mean standard deviation of the policy's actions.", ("", self.spread))
        add("process_cpu_seconds_total", "counter", "Processor time.", ("", time.process_time()))
        add("process_resident_memory_bytes", "gauge", "Memory.", ("", read_memory()))
        return "\n".join(lines) + "\n"


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")


def read_memory() -> int:
    """Return the memory of this process [bytes]; its peak on systems without /proc."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
