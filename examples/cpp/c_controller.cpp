// A controller of `rlctl export --controller`, compiled in, written to a file called controller.c. Its limits, its
// recurrent state and its histories are inside.
#include "controller.h"

#include "controller.hpp"

namespace {

constexpr const char* kStatus[] = {"idle", "running", "holding", "stopped"};

class CController : public Controller {
 public:
  CController() {
    description_.input_size = CONTROLLER_INPUT_SIZE;
    description_.command_size = CONTROLLER_ACTION_SIZE;
    description_.control_dt = CONTROLLER_CONTROL_DT;
#ifdef CONTROLLER_TARGET
    description_.command = CONTROLLER_TARGET;
#else
    description_.command = "action";
#endif
    for (int i = 0; i < CONTROLLER_INPUTS; ++i) {
      description_.input_names.emplace_back(controller_input_names[i]);
      description_.input_units.emplace_back(controller_input_units[i]);
      description_.input_sizes.push_back(controller_input_sizes[i]);
    }
    for (int i = 0; i < CONTROLLER_ACTION_SIZE; ++i) description_.joint_names.emplace_back(controller_action_names[i]);
    controller_init(&state_);
  }

  const Description& description() const override { return description_; }
  void reset() override { controller_reset(&state_); }

  void step(const float* numbers, double age_s, Output& output) override {
    static_assert(sizeof(controller_inputs) == CONTROLLER_INPUT_SIZE * sizeof(CONTROLLER_NUMBER), "numbers only");
    controller_inputs inputs;
    auto* values = reinterpret_cast<CONTROLLER_NUMBER*>(&inputs);
    for (int i = 0; numbers != nullptr && i < CONTROLLER_INPUT_SIZE; ++i) values[i] = numbers[i];
    controller_outputs outputs;
    output.may_send = controller_step(&state_, numbers == nullptr ? nullptr : &inputs, age_s, &outputs) != 0;
#ifdef CONTROLLER_TARGET
    output.command.assign(outputs.target, outputs.target + CONTROLLER_ACTION_SIZE);
#else
    output.command.assign(outputs.action, outputs.action + CONTROLLER_ACTION_SIZE);
#endif
    output.status = kStatus[outputs.status];
  }

 private:
  Description description_;
  controller_state state_;
};

}  // namespace

std::unique_ptr<Controller> load_controller(const std::string&) { return std::make_unique<CController>(); }
