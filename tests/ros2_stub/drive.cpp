// Drives the controller of examples/ros2_control, for the cart of tests/exporting/controlled.py, as a controller manager
// would: configures, activates, updates. The first argument leaves out what it names.
#include <cmath>
#include <iostream>

#include "rlctl_controller/rlctl_controller.hpp"

using controller_interface::CallbackReturn;
using controller_interface::return_type;

namespace {

const char* kLines[] = {"ok", "error"};

void publish_goal(rlctl_controller::RlctlController& controller) {
  auto subscription = std::static_pointer_cast<rclcpp::Subscription<rlctl_controller::Numbers>>(
      controller.get_node()->subscriptions.at("~/goal"));
  subscription->call(std::make_shared<rlctl_controller::Numbers>(rlctl_controller::Numbers{{0.5, -0.25}}));
}

}  // namespace

int main(int, char** arguments) {
  const std::string without = arguments[1];
  rlctl_controller::RlctlController controller;
  controller.update_rate = without == "rate" ? 15 : 20;
  controller.on_init();
  auto& parameters = controller.get_node()->parameters;
  parameters["inputs.places"].values = without == "entry" ? std::vector<std::string>{"a/b"} : std::vector<std::string>{"position"};
  parameters["inputs.goal"].values = {"topic"};
  if (controller.on_configure({}) != CallbackReturn::SUCCESS) return 2;

  // The hardware has its own order.
  double commands[2] = {9.0, 9.0}, places[2] = {0.25, -0.5};
  for (const std::string& name : controller.command_interface_configuration().names) std::cout << name << " ";
  for (const std::string& name : controller.state_interface_configuration().names) std::cout << name << " ";
  std::cout << "\n";
  controller.command_interfaces_.emplace_back("right/position", &commands[1]);
  if (without != "command") controller.command_interfaces_.emplace_back("left/position", &commands[0]);
  if (without != "state") controller.state_interfaces_.emplace_back("right/position", &places[1]);
  controller.state_interfaces_.emplace_back("left/position", &places[0]);
  if (controller.on_activate({}) != CallbackReturn::SUCCESS) return 3;

  for (int update = 0; update < 10; ++update) {
    if (update == 2) publish_goal(controller);
    if (update == 8) places[0] = std::nan("");
    const bool is_ok = controller.update({}, {}) == return_type::OK;
    std::cout << kLines[is_ok ? 0 : 1] << " " << commands[0] << " " << commands[1] << "\n";
  }
}
