// A controller as the loop sees it, whatever runs it.
#pragma once

#include <memory>
#include <string>
#include <vector>

struct Description {
  std::vector<std::string> input_names;  // what the robot measures, in the order of the numbers
  std::vector<std::string> input_units;  // a unit per name, "" if not known
  std::vector<int> input_sizes;          // numbers per name
  std::vector<std::string> joint_names;  // in the order of the command; empty if not known
  std::string command;                   // what a command is, in words
  int input_size = 0;
  int command_size = 0;
  double control_dt = 0.0;               // [s]
};

struct Output {
  std::vector<double> command;  // the joints' targets where the task says what an action commands, else the action
  bool may_send = false;        // false until the robot's position is known, and where there is no command
  std::string status;           // running, holding, stopped, idle
};

class Controller {
 public:
  virtual ~Controller() = default;
  virtual const Description& description() const = 0;
  virtual void reset() = 0;  // when an episode begins
  // `inputs` are the newest numbers, in the order of the description, and `age_s` old; a null pointer: there are none.
  virtual void step(const float* inputs, double age_s, Output& output) = 0;
};

// Throws std::runtime_error with a line that says what is wrong. `file` is not read where the controller is compiled in.
std::unique_ptr<Controller> load_controller(const std::string& file);
