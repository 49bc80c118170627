// A loop of a fixed rate around a controller: the newest numbers in, a command out.
#pragma once

#include <chrono>
#include <functional>
#include <mutex>
#include <vector>

#include "controller.hpp"

using Clock = std::chrono::steady_clock;

// The newest numbers, written by one thread and read by another.
class Newest {
 public:
  void put(std::vector<float> values);
  void close();  // nothing more will come
  // Copies the newest numbers and returns when they were put; nothing has come before that.
  Clock::time_point get(std::vector<float>& values, bool& closed);

 private:
  std::mutex mutex_;
  std::vector<float> values_;
  Clock::time_point time_ = Clock::time_point::min();
  bool closed_ = false;
};

struct Counts {
  long running = 0;  // commands of the policy
  long held = 0;     // periods in which the controller held the robot, or had no command
  long late = 0;     // periods that the loop began more than a tenth of a period late
};

// Runs until no more numbers come. `send` gets the outputs of each period.
Counts run_loop(Controller& controller, Newest& newest, const std::function<void(const Output&)>& send);
