#include "loop.hpp"

#include <thread>

namespace {

constexpr int kPatience = 3;  // periods without new numbers after which the loop ends, if no more will come

}  // namespace

void Newest::put(std::vector<float> values) {
  const std::lock_guard<std::mutex> lock(mutex_);
  values_ = std::move(values);
  time_ = Clock::now();
}

void Newest::close() {
  const std::lock_guard<std::mutex> lock(mutex_);
  closed_ = true;
}

Clock::time_point Newest::get(std::vector<float>& values, bool& closed) {
  const std::lock_guard<std::mutex> lock(mutex_);
  values = values_;
  closed = closed_;
  return time_;
}

Counts run_loop(Controller& controller, Newest& newest, const std::function<void(const Output&)>& send) {
  const Description& about = controller.description();
  const auto period = std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(about.control_dt));
  Counts counts;
  std::vector<float> inputs;
  Output output;
  auto next = Clock::now();
  controller.reset();
  for (;;) {
    bool closed = false;
    const Clock::time_point time = newest.get(inputs, closed);
    const bool is_complete = inputs.size() == static_cast<std::size_t>(about.input_size);
    const auto age = is_complete ? Clock::now() - time : Clock::duration::zero();
    controller.step(is_complete ? inputs.data() : nullptr, std::chrono::duration<double>(age).count(), output);
    send(output);
    ++(output.status == "running" ? counts.running : counts.held);
    if (closed && (!is_complete || age > (kPatience + 1) * period)) return counts;
    next += period;
    std::this_thread::sleep_until(next);
    const auto now = Clock::now();
    if (now > next + period / 10) {
      ++counts.late;
      if (now > next + period) next = now;  // what was missed is not made up for
    }
  }
}
