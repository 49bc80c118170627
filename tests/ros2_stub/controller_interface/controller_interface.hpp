// A stub of controller_interface, hardware_interface, rclcpp and rclcpp_lifecycle; see README.md.
#pragma once

#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#define RCLCPP_ERROR(logger, ...) ((void)(logger), std::fprintf(stderr, __VA_ARGS__), std::fputs("\n", stderr))

namespace rclcpp {
struct Logger {};
struct Time {};
struct Duration {};
struct SystemDefaultsQoS {};
class Parameter {
 public:
  std::vector<std::string> values;
  std::string as_string() const { return values.empty() ? "" : values[0]; }
  std::vector<std::string> as_string_array() const { return values; }
};
template <typename Message>
struct Subscription {
  using SharedPtr = std::shared_ptr<Subscription>;
  std::function<void(std::shared_ptr<Message>)> call;
};
}  // namespace rclcpp

namespace rclcpp_lifecycle {
struct State {};
class LifecycleNode {
 public:
  std::map<std::string, rclcpp::Parameter> parameters;
  std::map<std::string, std::shared_ptr<void>> subscriptions;
  rclcpp::Logger get_logger() const { return {}; }
  rclcpp::Parameter get_parameter(const std::string& name) const { return parameters.at(name); }
  template <typename Message, typename Callback>
  typename rclcpp::Subscription<Message>::SharedPtr create_subscription(
      const std::string& topic, const rclcpp::SystemDefaultsQoS&, Callback callback) {
    auto subscription = std::make_shared<rclcpp::Subscription<Message>>();
    subscription->call = callback;
    subscriptions[topic] = subscription;
    return subscription;
  }
};
}  // namespace rclcpp_lifecycle

namespace hardware_interface {
class Interface {
 public:
  Interface(std::string name, double* value) : name_(std::move(name)), value_(value) {}
  const std::string& get_name() const { return name_; }
  template <typename T = double>
  std::optional<T> get_optional() const {
    return *value_;
  }
  [[nodiscard]] bool set_value(double value) {
    *value_ = value;
    return true;
  }

 private:
  std::string name_;
  double* value_;
};
using LoanedCommandInterface = Interface;
using LoanedStateInterface = Interface;
}  // namespace hardware_interface

namespace controller_interface {
enum class CallbackReturn { SUCCESS, FAILURE, ERROR };
enum class return_type { OK, ERROR };
enum class interface_configuration_type { ALL, INDIVIDUAL, NONE };
struct InterfaceConfiguration {
  interface_configuration_type type;
  std::vector<std::string> names;
};

class ControllerInterface {
 public:
  virtual ~ControllerInterface() = default;
  virtual CallbackReturn on_init() = 0;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State&) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State&) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_deactivate(const rclcpp_lifecycle::State&) { return CallbackReturn::SUCCESS; }
  virtual return_type update(const rclcpp::Time&, const rclcpp::Duration&) = 0;

  template <typename T>
  void auto_declare(const std::string& name, const T&) {
    node_->parameters.try_emplace(name);
  }
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> get_node() const { return node_; }
  unsigned int get_update_rate() const { return update_rate; }

  unsigned int update_rate = 0;
  std::vector<hardware_interface::LoanedCommandInterface> command_interfaces_;
  std::vector<hardware_interface::LoanedStateInterface> state_interfaces_;

 private:
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> node_ = std::make_shared<rclcpp_lifecycle::LifecycleNode>();
};
}  // namespace controller_interface
