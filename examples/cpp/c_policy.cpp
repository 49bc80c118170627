// A policy of `rlctl export --c`, compiled in; for one without a memory, written to a file called policy.c.
#include "policy.h"

#include "policy.hpp"

namespace {

class CPolicy : public Policy {
 public:
  CPolicy() {
    description_.observation_size = POLICY_OBSERVATION_SIZE;
    description_.action_size = POLICY_ACTION_SIZE;
    description_.control_dt = POLICY_CONTROL_DT;
    for (int i = 0; i < POLICY_OBSERVATION_PARTS; ++i) {
      description_.observation_names.emplace_back(policy_observation_names[i]);
      description_.observation_units.emplace_back(policy_observation_units[i]);
      description_.observation_sizes.push_back(policy_observation_sizes[i]);
    }
    for (int i = 0; i < POLICY_ACTION_SIZE; ++i) {
      description_.action_names.emplace_back(policy_action_names[i]);
      description_.low.push_back(policy_action_low[i]);
      description_.high.push_back(policy_action_high[i]);
    }
  }
  const Description& description() const override { return description_; }
  void reset() override {}
  void act(const std::vector<float>& observation, std::vector<float>& action) override {
    action.resize(POLICY_ACTION_SIZE);
    policy_act(observation.data(), action.data());
  }

 private:
  Description description_;
};

}  // namespace

std::unique_ptr<Policy> load_policy(const std::string&) { return std::make_unique<CPolicy>(); }
