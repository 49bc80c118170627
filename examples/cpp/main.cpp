// policy_loop [controller.onnx]: a line of numbers per measurement on stdin, a line per command on stdout, with the
// controller's status before it.
//
// In a robot's program stdin and stdout are its drivers: read sensors where `read_numbers` is, in the order and the
// units that the description names, and send commands where `print` is.
#include <cstdio>
#include <exception>
#include <iostream>
#include <sstream>
#include <string>
#include <thread>

#include "loop.hpp"

namespace {

void read_numbers(Newest& newest) {
  for (std::string line; std::getline(std::cin, line);) {
    std::stringstream stream(line);
    std::vector<float> values;
    for (std::string word; stream >> word;) values.push_back(std::strtof(word.c_str(), nullptr));  // also nan
    newest.put(std::move(values));
  }
  newest.close();
}

void print(const Output& output) {
  std::fputs(output.status.c_str(), stdout);
  if (output.may_send) {
    for (double value : output.command) std::printf(" %.9g", value);
  }
  std::puts("");
  std::fflush(stdout);
}

void describe(const Description& about) {
  std::cerr << "inputs: " << about.input_size << " numbers";
  for (std::size_t i = 0; i < about.input_names.size() && i < about.input_sizes.size(); ++i) {
    std::cerr << (i == 0 ? ": " : ", ") << about.input_names[i] << " (" << about.input_sizes[i] << ")";
    if (i < about.input_units.size() && !about.input_units[i].empty()) std::cerr << " [" << about.input_units[i] << "]";
  }
  std::cerr << "\ncommand: " << about.command;
  for (std::size_t i = 0; i < about.joint_names.size(); ++i) std::cerr << (i == 0 ? " of " : ", ") << about.joint_names[i];
  std::cerr << "\nperiod: " << about.control_dt << " s\n";
}

}  // namespace

int main(int count, char** arguments) {
  try {
    const auto controller = load_controller(count > 1 ? arguments[1] : "controller.onnx");
    describe(controller->description());
    Newest newest;
    std::thread reader(read_numbers, std::ref(newest));
    const Counts counts = run_loop(*controller, newest, print);
    reader.join();
    std::cerr << counts.running << " commands, " << counts.held << " held, " << counts.late << " periods late\n";
  } catch (const std::exception& error) {
    std::cerr << "error: " << error.what() << "\n";
    return 1;
  }
}
