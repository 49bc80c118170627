// A policy in an ONNX file of `rlctl export --onnx`, on ONNX Runtime. Everything is allocated when it is loaded.
#include <onnxruntime_cxx_api.h>

#include <sstream>
#include <stdexcept>

#include "policy.hpp"

namespace {

std::vector<std::string> split(const std::string& text) {
  std::vector<std::string> parts;
  std::stringstream stream(text);
  for (std::string part; std::getline(stream, part, ',');) parts.push_back(part);
  return parts;
}

class OnnxPolicy : public Policy {
 public:
  explicit OnnxPolicy(const std::string& file)
      : env_(ORT_LOGGING_LEVEL_WARNING, "policy"), session_(env_, file.c_str(), make_options()),
        memory_(Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault)) {
    read_metadata();
    if (session_.GetInputCount() != 1 || session_.GetOutputCount() != 1) {
      throw std::runtime_error("this example has no recurrent state and no dict observations");
    }
    description_.observation_size = read_size(session_.GetInputTypeInfo(0), "obs");
    description_.action_size = read_size(session_.GetOutputTypeInfo(0), "action");
    int named = 0;
    for (int size : description_.observation_sizes) named += size;
    if (named != 0 && named != description_.observation_size) {
      throw std::runtime_error("its metadata names other elements than its input has; is it a stack of frames?");
    }
    input_.resize(description_.observation_size);
    const int64_t shape[] = {1, description_.observation_size};
    tensor_ = Ort::Value::CreateTensor<float>(memory_, input_.data(), input_.size(), shape, 2);
  }

  const Description& description() const override { return description_; }
  void reset() override {}

  void act(const std::vector<float>& observation, std::vector<float>& action) override {
    input_.assign(observation.begin(), observation.end());  // of the same size, so it stays where the tensor looks
    const char* inputs[] = {"obs"};
    const char* outputs[] = {"action"};
    auto result = session_.Run(Ort::RunOptions{nullptr}, inputs, &tensor_, 1, outputs, 1);
    const float* values = result[0].GetTensorData<float>();
    action.assign(values, values + description_.action_size);
  }

 private:
  static Ort::SessionOptions make_options() {
    Ort::SessionOptions options;
    options.SetIntraOpNumThreads(1);  // these networks are too small to share among threads
    return options;
  }

  static int read_size(const Ort::TypeInfo& type, const std::string& name) {
    const auto tensor = type.GetTensorTypeAndShapeInfo();
    const std::vector<int64_t> shape = tensor.GetShape();
    if (shape.size() != 2 || tensor.GetElementType() != ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT) {
      throw std::runtime_error("'" + name + "' is not of shape (batch, size) in float");
    }
    return static_cast<int>(shape[1]);
  }

  std::string look_up(const char* key) {
    const auto value = session_.GetModelMetadata().LookupCustomMetadataMapAllocated(key, allocator_);
    return value ? std::string(value.get()) : std::string();
  }

  void read_metadata() {
    description_.observation_names = split(look_up("observation_names"));
    for (const auto& size : split(look_up("observation_sizes"))) {
      description_.observation_sizes.push_back(std::stoi(size));
    }
    description_.observation_units = split(look_up("observation_units"));
    description_.action_names = split(look_up("joint_names"));
    for (const auto& value : split(look_up("action_low"))) description_.low.push_back(std::stof(value));
    for (const auto& value : split(look_up("action_high"))) description_.high.push_back(std::stof(value));
    const std::string period = look_up("control_dt");  // "0.02 s"
    if (period.empty()) throw std::runtime_error("its metadata has no control_dt: how fast is the loop to be?");
    description_.control_dt = std::stod(period);
  }

  Ort::Env env_;
  Ort::Session session_;
  Ort::MemoryInfo memory_;
  Ort::AllocatorWithDefaultOptions allocator_;
  Description description_;
  std::vector<float> input_;
  Ort::Value tensor_{nullptr};
};

}  // namespace

std::unique_ptr<Policy> load_policy(const std::string& file) {
  try {
    return std::make_unique<OnnxPolicy>(file);
  } catch (const Ort::Exception& error) {
    throw std::runtime_error(file + ": " + error.what());
  } catch (const std::exception& error) {
    throw std::runtime_error(file + ": " + error.what());
  }
}
