// A loop of a fixed rate around a policy: the newest observation in, a bounded action out, and a watchdog.
#pragma once

#include <functional>
#include <mutex>
#include <vector>

#include "policy.hpp"

// The newest observation, written by one thread and read by another.
class Newest {
 public:
  void put(std::vector<float> values);
  void close();  // nothing more will come
  // Returns how often something was put so far; copies the newest.
  long get(std::vector<float>& values, bool& closed);

 private:
  std::mutex mutex_;
  std::vector<float> values_;
  long count_ = 0;
  bool closed_ = false;
};

struct Counts {
  long steps = 0;     // actions of the policy
  long held = 0;      // periods without an observation that is new enough: the robot is to hold its position
  long clamped = 0;   // actions with an element outside its bounds
  long late = 0;      // periods that the loop began more than a tenth of a period late
};

// Runs until the observations end. `send` gets an action, or nothing where the robot is to hold.
Counts run_loop(Policy& policy, Newest& newest, const std::function<void(const std::vector<float>*)>& send);
