#include "loop.hpp"

#include <chrono>
#include <cmath>
#include <thread>

namespace {

constexpr int kPatience = 3;  // periods without a new observation until the robot holds

bool all_finite(const std::vector<float>& values) {
  for (float value : values) {
    if (!std::isfinite(value)) return false;
  }
  return true;
}

bool clamp(std::vector<float>& action, const Description& about) {
  bool changed = false;
  for (std::size_t i = 0; i < action.size() && i < about.low.size() && i < about.high.size(); ++i) {
    const float before = action[i];
    action[i] = std::fmin(std::fmax(before, about.low[i]), about.high[i]);
    changed = changed || action[i] != before;
  }
  return changed;
}

}  // namespace

void Newest::put(std::vector<float> values) {
  const std::lock_guard<std::mutex> lock(mutex_);
  values_ = std::move(values);
  ++count_;
}

void Newest::close() {
  const std::lock_guard<std::mutex> lock(mutex_);
  closed_ = true;
}

long Newest::get(std::vector<float>& values, bool& closed) {
  const std::lock_guard<std::mutex> lock(mutex_);
  values = values_;
  closed = closed_;
  return count_;
}

Counts run_loop(Policy& policy, Newest& newest, const std::function<void(const std::vector<float>*)>& send) {
  using Clock = std::chrono::steady_clock;
  const Description& about = policy.description();
  const auto period = std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(about.control_dt));
  Counts counts;
  std::vector<float> observation, action;
  long seen = 0;
  int missed = kPatience;  // nothing has come yet
  auto next = Clock::now();
  policy.reset();
  for (;;) {
    bool closed = false;
    const long count = newest.get(observation, closed);
    missed = count > seen ? 0 : missed + 1;
    seen = count;
    if (closed && missed >= kPatience) return counts;
    bool good = missed < kPatience && observation.size() == static_cast<std::size_t>(about.observation_size) &&
                all_finite(observation);
    if (good) {
      policy.act(observation, action);
      good = all_finite(action);
    }
    if (good) {
      counts.clamped += clamp(action, about) ? 1 : 0;
      ++counts.steps;
    } else {
      ++counts.held;
    }
    send(good ? &action : nullptr);
    next += period;
    std::this_thread::sleep_until(next);
    const auto now = Clock::now();
    if (now > next + period / 10) {
      ++counts.late;
      if (now > next + period) next = now;  // what was missed is not made up for
    }
  }
}
