// A policy of `rlctl export --c`, compiled in; for one without a memory, written to a file called policy.c.
#include "policy.h"

#include "policy.hpp"

namespace {

class CPolicy : public Policy {
 public:
  CPolicy() {
    description_.observation_size = POLICY_OBSERVATION_SIZE;
    description_.action_size = POLICY_ACTION_SIZE;
    description_.control_dt = POLICY_CONTROL_DT;  // the bounds are inside the function, the names in its header
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
