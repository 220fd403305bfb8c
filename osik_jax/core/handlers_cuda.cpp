// Handler of XLA's calls on a GPU: compiles CUDA text by NVRTC, keeps what was compiled, and launches it on XLA's stream.
//
// Neither CUDA's headers nor nvcc are needed: the driver and NVRTC are loaded while the program runs, and the functions
// in use are declared here (CUDA driver API and NVRTC reference).
#include <dlfcn.h>
#include <unistd.h>

#include <cstdint>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iterator>
#include <map>
#include <mutex>
#include <random>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>
#include <vector>

#include "xla.hpp"

using namespace osik;

namespace {
using Handle = void*;

constexpr int COMPUTE_MAJOR = 75, COMPUTE_MINOR = 76;  // CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_...
constexpr int DYNAMIC_SHARED = 8;                      // CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
constexpr int SHARED_WITHOUT_ASKING = 48 * 1024;       // bytes that every block may have

struct Cuda {
  int (*stream_context)(Handle, Handle*) = nullptr;
  int (*push)(Handle) = nullptr;
  int (*pop)(Handle*) = nullptr;
  int (*device)(int*) = nullptr;
  int (*device_attribute)(int*, int, int) = nullptr;
  int (*load)(Handle*, const void*) = nullptr;
  int (*function)(Handle*, Handle, const char*) = nullptr;
  int (*set_attribute)(Handle, int, int) = nullptr;
  int (*launch)(Handle, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, Handle, void**,
                void**) = nullptr;
  int (*create)(Handle*, const char*, const char*, int, const char* const*, const char* const*) = nullptr;
  int (*compile)(Handle, int, const char* const*) = nullptr;
  int (*cubin_size)(Handle, size_t*) = nullptr;
  int (*cubin)(Handle, char*) = nullptr;
  int (*log_size)(Handle, size_t*) = nullptr;
  int (*log)(Handle, char*) = nullptr;
  int (*destroy)(Handle*) = nullptr;
  std::string missing;

  explicit Cuda(const std::string& nvrtc_path) {
    void* driver = dlopen("libcuda.so.1", RTLD_NOW);
    void* nvrtc = dlopen(nvrtc_path.c_str(), RTLD_NOW);
    auto get = [&](auto& f, void* library, const char* name) {
      f = library ? reinterpret_cast<std::decay_t<decltype(f)>>(dlsym(library, name)) : nullptr;
      if (!f) missing += std::string(" ") + name;
    };
    get(stream_context, driver, "cuStreamGetCtx"), get(push, driver, "cuCtxPushCurrent_v2");
    get(pop, driver, "cuCtxPopCurrent_v2"), get(device, driver, "cuCtxGetDevice");
    get(device_attribute, driver, "cuDeviceGetAttribute"), get(load, driver, "cuModuleLoadData");
    get(function, driver, "cuModuleGetFunction"), get(set_attribute, driver, "cuFuncSetAttribute");
    get(launch, driver, "cuLaunchKernel"), get(create, nvrtc, "nvrtcCreateProgram");
    get(compile, nvrtc, "nvrtcCompileProgram"), get(cubin_size, nvrtc, "nvrtcGetCUBINSize");
    get(cubin, nvrtc, "nvrtcGetCUBIN"), get(log_size, nvrtc, "nvrtcGetProgramLogSize");
    get(log, nvrtc, "nvrtcGetProgramLog"), get(destroy, nvrtc, "nvrtcDestroyProgram");
  }
};

std::mutex mutex;
std::string nvrtc_path = "libnvrtc.so", cache_folder;  // set by osik_cuda_paths
std::map<std::pair<Handle, std::string>, Handle> functions;  // by context and key

const Cuda& cuda() {
  static const Cuda library(nvrtc_path);
  return library;
}

std::string code_of(const char* what, int code) { return std::string(what) + " failed with code " + std::to_string(code); }

uint64_t mark_of(const std::vector<char>& image) {  // FNV-1a
  uint64_t mark = 0xcbf29ce484222325u;
  for (const char byte : image) mark = (mark ^ uint8_t(byte)) * 0x100000001b3u;
  return mark;
}

// A compiled text on disk, which ends with its mark; empty where there is none, or it is damaged.
std::vector<char> cached(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::vector<char> image{std::istreambuf_iterator<char>(file), {}};
  uint64_t mark = 0;
  if (image.size() < sizeof mark) return {};
  std::memcpy(&mark, image.data() + image.size() - sizeof mark, sizeof mark);
  image.resize(image.size() - sizeof mark);
  return mark == mark_of(image) ? image : std::vector<char>();
}

// Write it under its name when it is whole. A disk that is full, or a folder that cannot be written, is no error.
void keep(const std::string& path, const std::vector<char>& image) {
  // of this process alone, here and on other machines that share the folder
  const std::string part = path + "." + std::to_string(getpid()) + "-" + std::to_string(std::random_device{}()) + ".part";
  std::ofstream file(part, std::ios::binary);
  const uint64_t mark = mark_of(image);
  file.write(image.data(), std::streamsize(image.size()));
  file.write(reinterpret_cast<const char*>(&mark), sizeof mark);
  file.close();  // which may be what meets a full disk
  if (!file || std::rename(part.c_str(), path.c_str())) std::remove(part.c_str());
}

// The compiled text, from the cache on disk if it is there. Returns an error's message, empty for none.
std::string compiled(std::string_view source, const std::string& key, const std::string& architecture,
                     std::vector<char>& image) {
  const std::string path = cache_folder.empty() ? "" : cache_folder + "/" + key + "_" + architecture + ".cubin";
  if (!path.empty()) image = cached(path);
  if (!image.empty()) return "";
  const Cuda& c = cuda();
  Handle program = nullptr;
  if (int code = c.create(&program, std::string(source).c_str(), "osik.cu", 0, nullptr, nullptr))
    return code_of("nvrtcCreateProgram", code);
  const std::string target = "--gpu-architecture=" + architecture;
  const char* options[] = {target.c_str(), "--std=c++20", "--device-as-default-execution-space"};
  std::string error;
  if (int code = c.compile(program, 3, options)) {
    size_t size = 0;
    c.log_size(program, &size);
    std::string log(size, ' ');
    c.log(program, log.data());
    error = code_of("nvrtcCompileProgram", code) + ": " + log;
  } else {
    size_t size = 0;
    c.cubin_size(program, &size);
    image.resize(size);
    c.cubin(program, image.data());
  }
  c.destroy(&program);
  if (error.empty() && !path.empty()) keep(path, image);
  return error;
}

std::string find_function(Handle context, std::string_view source, const std::string& key, Handle& out) {
  const std::lock_guard<std::mutex> guard(mutex);
  if (auto found = functions.find({context, key}); found != functions.end()) return out = found->second, "";
  const Cuda& c = cuda();
  int device = 0, major = 0, minor = 0;
  c.device(&device);
  c.device_attribute(&major, COMPUTE_MAJOR, device);
  c.device_attribute(&minor, COMPUTE_MINOR, device);
  std::vector<char> image;
  const std::string architecture = "sm_" + std::to_string(10 * major + minor);
  if (std::string error = compiled(source, key, architecture, image); !error.empty()) return error;
  Handle module = nullptr;
  if (int code = c.load(&module, image.data())) return code_of("cuModuleLoadData", code);
  if (int code = c.function(&out, module, "osik_kernel")) return code_of("cuModuleGetFunction", code);
  functions[{context, key}] = out;
  return "";
}

std::string_view text(const xla::Attributes& a, std::string_view name) {
  for (int64_t i = 0; i < a.size; ++i)
    if (std::string_view(a.names[i]->data, a.names[i]->size) == name) {
      const xla::Text* value = static_cast<const xla::Text*>(a.values[i]);
      return {value->data, value->size};
    }
  return {};
}

// Launch osik_kernel(arguments..., results..., problems): `threads` threads a block, `per_block` problems each.
std::string launch(xla::CallFrame* frame) {
  const Cuda& c = cuda();
  if (!c.missing.empty()) return "the CUDA driver or NVRTC (" + nvrtc_path + ") lacks" + c.missing;
  xla::StreamArguments stream{sizeof(xla::StreamArguments), nullptr, frame->context, nullptr};
  if (frame->api->get_stream(&stream)) return "XLA has no stream for this call";
  Handle context = nullptr, popped = nullptr, function = nullptr;
  if (int code = c.stream_context(stream.stream, &context)) return code_of("cuStreamGetCtx", code);
  c.push(context);
  const xla::Attributes& a = frame->attributes;
  std::string error = find_function(context, text(a, "source"), std::string(text(a, "key")), function);
  if (error.empty()) {
    std::vector<void*> data, pointers;
    for (int64_t i = 0; i < frame->arguments.size; ++i) data.push_back(frame->arguments.buffers[i]->data);
    for (int64_t i = 0; i < frame->results.size; ++i) data.push_back(frame->results.buffers[i]->data);
    for (auto& pointer : data) pointers.push_back(&pointer);
    int32_t problems = xla::number(a, "problems"), shared = xla::number(a, "shared");
    const int32_t per_block = xla::number(a, "per_block"), threads = xla::number(a, "threads");
    pointers.push_back(&problems);
    if (shared > SHARED_WITHOUT_ASKING) c.set_attribute(function, DYNAMIC_SHARED, shared);
    if (problems > 0)
      if (int code = c.launch(function, (problems + per_block - 1) / per_block, 1, 1, threads, 1, 1, shared, stream.stream,
                              pointers.data(), nullptr))
        error = code_of("cuLaunchKernel", code);
  }
  c.pop(&popped);
  return error;
}
}  // namespace

extern "C" {
// Where NVRTC is, and the folder of compiled kernels; "" for none. Before the first call.
void osik_cuda_paths(const char* nvrtc, const char* cache) { nvrtc_path = nvrtc, cache_folder = cache; }

void* osik_cuda(xla::CallFrame* frame) {
  if (!xla::is_call(frame)) return nullptr;
  const std::string problem = launch(frame);
  return problem.empty() ? nullptr : xla::error(frame, problem.c_str());
}
}
