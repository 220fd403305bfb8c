// What XLA hands to a kernel: the call frame of its foreign function interface (FFI).
//
// The structures are those of xla/ffi/api/c_api.h on 64-bit machines, declared here so that one library serves every
// jaxlib that pyproject.toml allows: their layout is the same from interface 0.1 (jax 0.8) to 0.5. A handler answers
// XLA's question for its version with the version that XLA itself has.
#pragma once
#include <cstddef>
#include <cstdint>
#include <exception>
#include <stdexcept>
#include <string_view>
#include <type_traits>
#include <vector>

namespace osik::xla {

struct Extension {
  size_t struct_size;
  int32_t type;
  Extension* next;
};

struct Metadata {
  size_t struct_size;
  size_t version_struct_size;
  Extension* version_extension;
  int32_t major, minor;
  uint32_t traits;
};

struct MetadataExtension {
  Extension base;
  Metadata* metadata;
};

struct Buffer {
  size_t struct_size;
  Extension* extension;
  int32_t dtype;
  void* data;
  int64_t rank;
  int64_t* dimensions;
};

struct List {  // arguments or results
  size_t struct_size;
  Extension* extension;
  int64_t size;
  int32_t* types;
  Buffer** buffers;
};

struct Text {
  const char* data;
  size_t size;
};

struct Scalar {
  int32_t dtype;
  void* value;
};

struct Attributes {  // sorted by name; an entry points to a Scalar or a Text, as its type says
  size_t struct_size;
  Extension* extension;
  int64_t size;
  int32_t* types;
  Text** names;
  void** values;
};

struct ErrorArguments {
  size_t struct_size;
  Extension* extension;
  const char* message;
  int32_t code;
};

struct StreamArguments {
  size_t struct_size;
  Extension* extension;
  void* context;
  void* stream;
};

struct Api {  // functions that are not used are named by their place alone
  size_t struct_size;
  Extension* extension;
  size_t version_struct_size;
  Extension* version_extension;
  int32_t major, minor;
  void* internal;
  void* (*create_error)(ErrorArguments*);
  void* unused_error[2];
  void* register_handler;
  void* (*get_stream)(StreamArguments*);
};

struct CallFrame {
  size_t struct_size;
  Extension* extension;
  const Api* api;
  void* context;
  int32_t stage;
  List arguments, results;
  Attributes attributes;
};

constexpr int METADATA = 1, EXECUTE = 3, INTERNAL_ERROR = 13, OLDEST_MINOR = 1;

// Whether XLA wants the kernel to run. Its question for the interface's version is answered on the way.
inline bool is_call(CallFrame* frame, uint32_t traits = 0) {
  Extension* extension = frame->extension;
  if (extension && extension->type == METADATA) {
    Metadata* metadata = reinterpret_cast<MetadataExtension*>(extension)->metadata;
    metadata->major = 0;
    metadata->minor = frame->api ? frame->api->minor : OLDEST_MINOR;
    metadata->traits = traits;
    return false;
  }
  return frame->stage == EXECUTE;
}

// An attribute of a call that is an integer; 0 if there is none of this name.
inline int32_t number(const Attributes& a, std::string_view name) {
  for (int64_t i = 0; i < a.size; ++i)
    if (std::string_view(a.names[i]->data, a.names[i]->size) == name)
      return *static_cast<const int32_t*>(static_cast<const Scalar*>(a.values[i])->value);
  return 0;
}

// The buffers of one call; every buffer has a leading axis of problems unless said otherwise. What a kernel asks for that
// the call does not have is an error: a buffer, an axis, or numbers of another type.
struct Call {
  CallFrame* frame;
  static void require(bool holds, const char* problem) {
    if (!holds) [[unlikely]]
      throw std::invalid_argument(problem);
  }
  static const Buffer& buffer(const List& all, int k) {
    require(k < all.size, "the core was called with too few arrays");
    return *all.buffers[k];
  }
  static int length(const Buffer& buffer, int axis) {
    require(axis < buffer.rank, "the core was called with an array that has too few axes");
    return int(buffer.dimensions[axis]);
  }
  template <class T> static T* data(const Buffer& buffer) {
    constexpr int32_t INT32 = 4, FLOAT64 = 12;  // of XLA's PrimitiveType
    require(buffer.dtype == (std::is_same_v<T, double> ? FLOAT64 : INT32),
            "the core was called with numbers of another type");
    return static_cast<T*>(buffer.data);
  }
  const Buffer& argument(int k) const { return buffer(frame->arguments, k); }
  const Buffer& result(int k) const { return buffer(frame->results, k); }
  int size(int k, int axis) const { return length(argument(k), axis); }
  int result_size(int k, int axis) const { return length(result(k), axis); }
  template <class T> const T* in(int k) const { return data<T>(argument(k)); }
  template <class T> T* out(int k) const { return data<T>(result(k)); }

  // How many numbers one lane of a buffer has. Its leading axis is that of the lanes, or has length 1 where all share it.
  static size_t numbers_of_lane(const Buffer& buffer) {
    size_t count = 1;
    for (int axis = 1; axis < buffer.rank; ++axis) count *= buffer.dimensions[axis];
    return count;
  }
  template <class T> const T* of_lane(int k, int lane) const {
    return in<T>(k) + (size(k, 0) > 1 ? numbers_of_lane(argument(k)) * lane : 0);
  }
  template <class T> T* out(int k, int lane) const { return out<T>(k) + numbers_of_lane(result(k)) * lane; }
};

// A call as methods take it that are written for a CPU and a GPU: kinematic_calls.hpp says what its words mean.
struct Batch {
  using Real = double;
  using In = const double*;
  using Out = double*;
  using Numbers = const double*;
  using Space = std::vector<double>;
  Call call;
  Space space() const { return Space(number(call.frame->attributes, "space")); }
  int size(int k, int axis) const { return call.size(k, axis); }
  int result_size(int k, int axis) const { return call.result_size(k, axis); }
  const int* integers(int k, int lane = 0) const { return call.of_lane<int>(k, lane); }
  In in(int k, int lane) const { return call.of_lane<double>(k, lane); }
  Numbers numbers(int k, int lane) const { return in(k, lane); }
  Out out(int k, int lane) const { return call.out<double>(k, lane); }
  int* labels(int k, int lane) const { return call.out<int>(k, lane); }
  template <class F> void each_lane(F f) const {
    for (int lane = 0; lane < result_size(0, 0); ++lane) f(lane);
  }
};

// An error that XLA raises in Python with this message.
inline void* error(CallFrame* frame, const char* message) {
  ErrorArguments arguments{sizeof(ErrorArguments), nullptr, message, INTERNAL_ERROR};
  return frame->api->create_error(&arguments);
}

// What XLA calls: `solve` on the buffers of a call that wants the kernel to run.
template <void (*solve)(const Call&)> void* handle(CallFrame* frame) {
  if (!is_call(frame)) return nullptr;
  try {
    solve(Call{frame});
  } catch (const std::exception& problem) {  // no memory, or arrays of another kind
    return error(frame, problem.what());
  }
  return nullptr;
}
template <void (*solve)(const Batch&)> void of_batch(const Call& call) { solve(Batch{call}); }

}  // namespace osik::xla
