// A policy as the loop sees it, whatever runs it.
#pragma once

#include <memory>
#include <string>
#include <vector>

struct Description {
  std::vector<std::string> observation_names;  // in the order of the observation; empty if not known
  std::vector<std::string> observation_units;  // a unit per name, "" if not known
  std::vector<int> observation_sizes;          // elements per name
  std::vector<std::string> action_names;       // in the order of the action, joints if known; empty if not known
  int observation_size = 0;
  int action_size = 0;
  double control_dt = 0.0;         // [s]
  std::vector<float> low, high;    // bounds of the action; empty if not known
};

class Policy {
 public:
  virtual ~Policy() = default;
  virtual const Description& description() const = 0;
  virtual void reset() = 0;  // when an episode begins
  virtual void act(const std::vector<float>& observation, std::vector<float>& action) = 0;
};

// Throws std::runtime_error with a line that says what is wrong. `file` is not read where the policy is compiled in.
std::unique_ptr<Policy> load_policy(const std::string& file);
