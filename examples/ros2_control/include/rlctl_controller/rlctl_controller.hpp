// A ros2_control controller around the C file of `rlctl export --controller`. Names of joints and inputs come from its
// header; nothing is mapped by a number that somebody copied.
#pragma once

#include <array>
#include <memory>
#include <string>
#include <vector>

#include <controller_interface/controller_interface.hpp>
#include <realtime_tools/realtime_buffer.hpp>
#include <std_msgs/msg/float64_multi_array.hpp>

#include "controller.h"

namespace rlctl_controller {

using Numbers = std_msgs::msg::Float64MultiArray;

class RlctlController : public controller_interface::ControllerInterface {
 public:
  controller_interface::CallbackReturn on_init() override;
  controller_interface::InterfaceConfiguration command_interface_configuration() const override;
  controller_interface::InterfaceConfiguration state_interface_configuration() const override;
  controller_interface::CallbackReturn on_configure(const rclcpp_lifecycle::State& previous) override;
  controller_interface::CallbackReturn on_activate(const rclcpp_lifecycle::State& previous) override;
  controller_interface::CallbackReturn on_deactivate(const rclcpp_lifecycle::State& previous) override;
  controller_interface::return_type update(const rclcpp::Time& time, const rclcpp::Duration& period) override;

 private:
  // An input of the policy: state interfaces by name, or a topic.
  struct Input {
    std::vector<std::string> names;   // of state interfaces; empty for a topic
    std::vector<std::size_t> places;  // in state_interfaces_, found when the controller is activated
    realtime_tools::RealtimeBuffer<std::shared_ptr<Numbers>> newest;
    rclcpp::Subscription<Numbers>::SharedPtr subscription;
    int first = 0;  // place among the numbers of the policy
    int size = 0;
  };

  bool find_interfaces();
  bool read_inputs(controller_inputs& inputs);
  controller_interface::return_type write_commands();

  std::array<Input, CONTROLLER_INPUTS> inputs_;
  std::string command_interface_;
  std::array<std::size_t, CONTROLLER_ACTION_SIZE> commands_{};  // places in command_interfaces_
  controller_state state_{};
  controller_outputs outputs_{};
  unsigned int every_ = 1;  // the policy acts in every so many updates
  unsigned int count_ = 0;
  bool may_send_ = false;
};

}  // namespace rlctl_controller
