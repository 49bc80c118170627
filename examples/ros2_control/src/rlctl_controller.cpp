#include "rlctl_controller/rlctl_controller.hpp"

#include <cmath>

#include <pluginlib/class_list_macros.hpp>

#ifndef CONTROLLER_TARGET
#error "this task does not say what its actions command: describe_joints() needs action_scale or another of its kind"
#endif

namespace rlctl_controller {

using controller_interface::CallbackReturn;
using controller_interface::InterfaceConfiguration;
using controller_interface::interface_configuration_type;
using controller_interface::return_type;

constexpr double kTolerance = 0.01;  // by which the period of an update may differ from control_dt

namespace {

// Returns where a name is, or the number of interfaces if it is missing.
template <typename Interfaces>
std::size_t find(const Interfaces& interfaces, const std::string& name) {
  std::size_t place = 0;
  while (place < interfaces.size() && interfaces[place].get_name() != name) ++place;
  return place;
}

}  // namespace

CallbackReturn RlctlController::on_init() {
  for (int i = 0; i < CONTROLLER_INPUTS; ++i) {
    auto_declare<std::vector<std::string>>("inputs." + std::string(controller_input_names[i]), {});
  }
  auto_declare<std::string>("command_interface", "");
  return CallbackReturn::SUCCESS;
}

CallbackReturn RlctlController::on_configure(const rclcpp_lifecycle::State&) {
  const auto logger = get_node()->get_logger();
  command_interface_ = get_node()->get_parameter("command_interface").as_string();
  if (command_interface_.empty()) command_interface_ = CONTROLLER_TARGET;
  const double updates = CONTROLLER_CONTROL_DT * get_update_rate();
  every_ = static_cast<unsigned int>(std::lround(updates));
  if (every_ == 0 || std::fabs(updates / every_ - 1.0) > kTolerance) {
    RCLCPP_ERROR(logger, "update_rate %u Hz: it must be a whole multiple of %g Hz", get_update_rate(),
                 1.0 / CONTROLLER_CONTROL_DT);
    return CallbackReturn::ERROR;
  }
  int first = 0;
  for (int i = 0; i < CONTROLLER_INPUTS; ++i) {
    Input& input = inputs_[i];
    const std::string name = controller_input_names[i];
    input.names = get_node()->get_parameter("inputs." + name).as_string_array();
    input.size = controller_input_sizes[i];
    input.first = first;
    first += input.size;
    if (input.names == std::vector<std::string>{"topic"}) {
      input.names.clear();
      input.subscription = get_node()->create_subscription<Numbers>(
          "~/" + name, rclcpp::SystemDefaultsQoS(),
          [&input](const std::shared_ptr<Numbers> message) { input.newest.writeFromNonRT(message); });
      continue;
    }
    const bool is_kind = input.names.size() == 1 && input.names[0].find('/') == std::string::npos;
    if (is_kind && input.size == CONTROLLER_ACTION_SIZE) {
      const std::string kind = input.names[0];
      input.names.clear();
      for (const char* joint : controller_action_names) input.names.push_back(std::string(joint) + "/" + kind);
    }
    if (input.names.size() != static_cast<std::size_t>(input.size)) {
      RCLCPP_ERROR(logger, "inputs.%s: %zu names, the policy takes %d numbers [%s]", name.c_str(), input.names.size(),
                   input.size, controller_input_units[i]);
      return CallbackReturn::ERROR;
    }
  }
  return CallbackReturn::SUCCESS;
}

InterfaceConfiguration RlctlController::command_interface_configuration() const {
  InterfaceConfiguration configuration{interface_configuration_type::INDIVIDUAL, {}};
  for (const char* joint : controller_action_names) {
    configuration.names.push_back(std::string(joint) + "/" + command_interface_);
  }
  return configuration;
}

InterfaceConfiguration RlctlController::state_interface_configuration() const {
  InterfaceConfiguration configuration{interface_configuration_type::INDIVIDUAL, {}};
  for (const Input& input : inputs_) {
    configuration.names.insert(configuration.names.end(), input.names.begin(), input.names.end());
  }
  return configuration;
}

bool RlctlController::find_interfaces() {
  const auto logger = get_node()->get_logger();
  for (int i = 0; i < CONTROLLER_ACTION_SIZE; ++i) {
    const std::string name = std::string(controller_action_names[i]) + "/" + command_interface_;
    commands_[i] = find(command_interfaces_, name);
    if (commands_[i] == command_interfaces_.size()) {
      RCLCPP_ERROR(logger, "the hardware has no command interface %s", name.c_str());
      return false;
    }
  }
  for (Input& input : inputs_) {
    input.places.clear();
    for (const std::string& name : input.names) {
      input.places.push_back(find(state_interfaces_, name));
      if (input.places.back() == state_interfaces_.size()) {
        RCLCPP_ERROR(logger, "the hardware has no state interface %s", name.c_str());
        return false;
      }
    }
  }
  return true;
}

CallbackReturn RlctlController::on_activate(const rclcpp_lifecycle::State&) {
  if (!find_interfaces()) return CallbackReturn::ERROR;  // never guess
  controller_init(&state_);
  may_send_ = false;
  count_ = 0;
  return CallbackReturn::SUCCESS;
}

CallbackReturn RlctlController::on_deactivate(const rclcpp_lifecycle::State&) { return CallbackReturn::SUCCESS; }

bool RlctlController::read_inputs(controller_inputs& inputs) {
  static_assert(sizeof(controller_inputs) == CONTROLLER_INPUT_SIZE * sizeof(CONTROLLER_NUMBER), "numbers only");
  auto* numbers = reinterpret_cast<CONTROLLER_NUMBER*>(&inputs);
  for (Input& input : inputs_) {
    if (input.names.empty()) {
      const std::shared_ptr<Numbers> message = *input.newest.readFromRT();
      if (!message || message->data.size() != static_cast<std::size_t>(input.size)) return false;
      for (int i = 0; i < input.size; ++i) numbers[input.first + i] = static_cast<CONTROLLER_NUMBER>(message->data[i]);
      continue;
    }
    for (int i = 0; i < input.size; ++i) {  // no value is not a number: the limits hold the robot
      const auto value = state_interfaces_[input.places[i]].get_optional();
      numbers[input.first + i] = static_cast<CONTROLLER_NUMBER>(value.value_or(std::nan("")));
    }
  }
  return true;
}

return_type RlctlController::update(const rclcpp::Time&, const rclcpp::Duration&) {
  if (count_++ % every_ != 0) return return_type::OK;  // the command of the last step stays
  controller_inputs inputs;
  const bool is_complete = read_inputs(inputs);
  may_send_ = controller_step(&state_, is_complete ? &inputs : nullptr, 0.0, &outputs_) != 0;
  return write_commands();
}

return_type RlctlController::write_commands() {
  for (int i = 0; may_send_ && i < CONTROLLER_ACTION_SIZE; ++i) {
    (void)command_interfaces_[commands_[i]].set_value(outputs_.target[i]);
  }
  return outputs_.status == CONTROLLER_STOPPED ? return_type::ERROR : return_type::OK;
}

}  // namespace rlctl_controller

PLUGINLIB_EXPORT_CLASS(rlctl_controller::RlctlController, controller_interface::ControllerInterface)
