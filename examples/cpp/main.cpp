// policy_loop [policy.onnx]: a line of numbers per observation on stdin, a line per action, or `hold`, on stdout.
//
// In a robot's program stdin and stdout are its drivers: read sensors where `read_observations` is, in the order and the
// units that the description names, and send commands where `print` is.
#include <cstdio>
#include <exception>
#include <iostream>
#include <sstream>
#include <string>
#include <thread>

#include "loop.hpp"

namespace {

void read_observations(Newest& newest) {
  for (std::string line; std::getline(std::cin, line);) {
    std::stringstream stream(line);
    std::vector<float> values;
    for (float value; stream >> value;) values.push_back(value);
    newest.put(std::move(values));
  }
  newest.close();
}

void print(const std::vector<float>* action) {
  if (action == nullptr) {
    std::puts("hold");
  } else {
    for (float value : *action) std::printf("%.9g ", static_cast<double>(value));
    std::puts("");
  }
  std::fflush(stdout);
}

void describe(const Description& about) {
  std::cerr << "observation: " << about.observation_size << " elements";
  for (std::size_t i = 0; i < about.observation_names.size() && i < about.observation_sizes.size(); ++i) {
    std::cerr << (i == 0 ? ": " : ", ") << about.observation_names[i] << " (" << about.observation_sizes[i] << ")";
    if (i < about.observation_units.size() && !about.observation_units[i].empty()) {
      std::cerr << " [" << about.observation_units[i] << "]";
    }
  }
  std::cerr << "\naction: " << about.action_size << " elements";
  for (std::size_t i = 0; i < about.action_names.size(); ++i) {
    std::cerr << (i == 0 ? ": " : ", ") << about.action_names[i];
    if (i < about.low.size() && i < about.high.size()) std::cerr << " (" << about.low[i] << " to " << about.high[i] << ")";
  }
  std::cerr << "\nperiod: " << about.control_dt << " s\n";
}

}  // namespace

int main(int count, char** arguments) {
  try {
    const auto policy = load_policy(count > 1 ? arguments[1] : "policy.onnx");
    describe(policy->description());
    Newest newest;
    std::thread reader(read_observations, std::ref(newest));
    const Counts counts = run_loop(*policy, newest, print);
    reader.join();
    std::cerr << counts.steps << " actions, " << counts.held << " held, " << counts.clamped << " clamped, " << counts.late
              << " periods late\n";
  } catch (const std::exception& error) {
    std::cerr << "error: " << error.what() << "\n";
    return 1;
  }
}
