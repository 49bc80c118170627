// A controller in an ONNX file of `rlctl export --controller`, on ONNX Runtime. Everything is allocated when it is loaded
// but what ONNX Runtime returns. The file has no limits: this one only refuses numbers that are old or not finite.
#include <onnxruntime_cxx_api.h>

#include <cmath>
#include <cstring>
#include <sstream>
#include <stdexcept>

#include "controller.hpp"

namespace {

constexpr int kPatience = 3;  // periods after which inputs are too old

std::vector<std::string> split(const std::string& text) {
  std::vector<std::string> parts;
  std::stringstream stream(text);
  for (std::string part; std::getline(stream, part, ',');) parts.push_back(part);
  return parts;
}

// An input of the graph and its numbers; a state is zero when an episode begins.
struct Port {
  std::string name;
  std::vector<int64_t> shape;
  std::vector<char> numbers;
  ONNXTensorElementDataType type;
  Ort::Value tensor{nullptr};
};

class OnnxController : public Controller {
 public:
  explicit OnnxController(const std::string& file)
      : env_(ORT_LOGGING_LEVEL_WARNING, "controller"), session_(env_, file.c_str(), make_options()),
        memory_(Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault)) {
    read_metadata();
    ports_.resize(session_.GetInputCount());
    for (std::size_t i = 0; i < ports_.size(); ++i) add_port(i);
    for (const std::string& name : description_.input_names) find_port(name);
    for (std::size_t i = 0; i < session_.GetOutputCount(); ++i) {
      output_names_.push_back(session_.GetOutputNameAllocated(i, allocator_).get());
      if (output_names_.back() == "target") command_ = i;
    }
    const auto info = session_.GetOutputTypeInfo(command_);  // what it returns is a part of it
    description_.command_size = static_cast<int>(info.GetTensorTypeAndShapeInfo().GetShape().back());
  }

  const Description& description() const override { return description_; }

  void reset() override {
    for (Port& port : ports_) std::fill(port.numbers.begin(), port.numbers.end(), 0);
  }

  void step(const float* numbers, double age_s, Output& output) override {
    bool good = numbers != nullptr && std::fabs(age_s) <= kPatience * description_.control_dt;
    for (int i = 0; good && i < description_.input_size; ++i) good = std::isfinite(numbers[i]);
    output.status = good ? "running" : "holding";
    output.may_send = good;
    if (!good) return;
    for (std::size_t i = 0; i < description_.input_names.size(); ++i) {
      write(find_port(description_.input_names[i]), numbers, description_.input_sizes[i]);
      numbers += description_.input_sizes[i];
    }
    run(output);
  }

 private:
  static Ort::SessionOptions make_options() {
    Ort::SessionOptions options;
    options.SetIntraOpNumThreads(1);  // these networks are too small to share among threads
    return options;
  }

  void add_port(std::size_t index) {
    Port& port = ports_[index];
    port.name = session_.GetInputNameAllocated(index, allocator_).get();
    const auto info = session_.GetInputTypeInfo(index);
    const auto type = info.GetTensorTypeAndShapeInfo();
    port.shape = type.GetShape();
    port.type = type.GetElementType();
    std::size_t count = port.type == ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT ? sizeof(float) : 8;
    for (int64_t& size : port.shape) {
      size = size < 0 ? 1 : size;  // the batch
      count *= static_cast<std::size_t>(size);
    }
    port.numbers.assign(count, 0);
    port.tensor = Ort::Value::CreateTensor(memory_, port.numbers.data(), count, port.shape.data(), port.shape.size(), port.type);
  }

  Port& find_port(const std::string& name) {
    for (Port& port : ports_) {
      if (port.name == name) return port;
    }
    throw std::runtime_error("it has no input '" + name + "'");
  }

  static void write(Port& port, const float* numbers, int count) {
    if (port.type == ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT) {
      std::memcpy(port.numbers.data(), numbers, static_cast<std::size_t>(count) * sizeof(float));
      return;
    }
    auto* values = reinterpret_cast<double*>(port.numbers.data());
    for (int i = 0; i < count; ++i) values[i] = numbers[i];
  }

  void run(Output& output) {
    std::vector<const char*> inputs, outputs;
    for (Port& port : ports_) inputs.push_back(port.name.c_str());
    for (const std::string& name : output_names_) outputs.push_back(name.c_str());
    std::vector<Ort::Value> tensors;
    for (Port& port : ports_) tensors.push_back(std::move(port.tensor));
    auto results = session_.Run(Ort::RunOptions{nullptr}, inputs.data(), tensors.data(), inputs.size(), outputs.data(),
                                outputs.size());
    for (std::size_t i = 0; i < ports_.size(); ++i) ports_[i].tensor = std::move(tensors[i]);
    const auto count = static_cast<std::size_t>(description_.command_size);
    output.command.resize(count);
    for (std::size_t i = 0; i < count; ++i) {
      output.command[i] = output_names_[command_] == "target" ? results[command_].GetTensorData<double>()[i]
                                                              : results[command_].GetTensorData<float>()[i];
    }
    for (std::size_t i = 0; i < output_names_.size(); ++i) {  // the state for the next step
      const std::size_t end = output_names_[i].rfind("_out");
      if (end == std::string::npos) continue;
      Port& port = find_port(output_names_[i].substr(0, end));
      std::memcpy(port.numbers.data(), results[i].GetTensorRawData(), port.numbers.size());
    }
  }

  std::string look_up(const char* key) {
    const auto value = session_.GetModelMetadata().LookupCustomMetadataMapAllocated(key, allocator_);
    return value ? std::string(value.get()) : std::string();
  }

  void read_metadata() {
    description_.input_names = split(look_up("input_names"));
    if (description_.input_names.empty()) throw std::runtime_error("it is no controller: write it with export --controller");
    for (const auto& size : split(look_up("input_sizes"))) {
      description_.input_sizes.push_back(std::stoi(size));
      description_.input_size += description_.input_sizes.back();
    }
    description_.input_units = split(look_up("input_units"));
    description_.joint_names = split(look_up("joint_names"));
    description_.command = look_up("target");
    if (description_.command.empty()) description_.command = "action";
    const std::string period = look_up("control_dt");  // "0.02 s"
    if (period.empty()) throw std::runtime_error("its metadata has no control_dt: how fast is the loop to be?");
    description_.control_dt = std::stod(period);
  }

  Ort::Env env_;
  Ort::Session session_;
  Ort::MemoryInfo memory_;
  Ort::AllocatorWithDefaultOptions allocator_;
  Description description_;
  std::vector<Port> ports_;
  std::vector<std::string> output_names_;
  std::size_t command_ = 0;  // which output is the command
};

}  // namespace

std::unique_ptr<Controller> load_controller(const std::string& file) {
  try {
    return std::make_unique<OnnxController>(file);
  } catch (const std::exception& error) {
    throw std::runtime_error(file + ": " + error.what());
  }
}
