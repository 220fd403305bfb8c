// The functions of osik.h: a controller's file, and steps by ../step.hpp.
#include "osik.h"

#include <algorithm>
#include <cstdint>
#include <fstream>
#include <iterator>
#include <memory>

#include "../manifold.hpp"
#include "../step.hpp"
#include "layout_check.hpp"
#include "section.hpp"

using namespace osik;

namespace {
constexpr size_t APART = 0;  // of the robots in a batch: there is one
constexpr int SECTION = 2;  // VERSION in control/_packed_step.py
constexpr char FORMAT[] = "{\n \"format\": \"osik-jax controller ",
               CORE[] = ",\n \"core\": ", CHECK[] = ",\n \"checksum\": ";
constexpr double ROUNDED = 0.02, EXACT = 64 * EPSILON,  // numerics/_rotations.py
    SHORTEST = 1e-14;                      // squared length of a quaternion that has a direction

struct Input {  // q or a target: where it is among the numbers of a step
  std::string name;
  int first, count;
  bool is_rotation;
};

constexpr auto require = LayoutCheck::require;
constexpr auto require_within = LayoutCheck::require_within;
[[noreturn]] void refuse(const std::string& reason) { throw std::runtime_error(reason); }

uint32_t checksum(const char* text, size_t count) {  // CRC-32, as zlib has it
  uint32_t sum = ~0u;
  for (size_t i = 0; i < count; ++i) {
    sum ^= uint8_t(text[i]);
    for (int bit = 0; bit < 8; ++bit) sum = sum >> 1 ^ (sum & 1 ? 0xEDB88320u : 0u);
  }
  return ~sum;
}

Json read_section(const char* path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) refuse("it cannot be read");
  const std::string text{std::istreambuf_iterator<char>(file), {}};
  if (text.rfind(FORMAT, 0) != 0) refuse("it is no controller that osik_jax.save_controller wrote");
  const size_t check = text.rfind(CHECK), core = text.rfind(CORE, check);
  if (check == std::string::npos || core == std::string::npos)
    refuse(text.ends_with("\n}\n") ? "an older osik_jax wrote it: save it again" : "its end is missing");
  if (std::to_string(checksum(text.data(), check)) + "\n}\n" != text.substr(check + sizeof(CHECK) - 1))
    refuse("it is not as osik_jax.save_controller wrote it: save it again in place of editing it");
  Json section = JsonReader(text.c_str() + core + sizeof(CORE) - 1).value();
  if (section["version"].number != SECTION)
    refuse("it is for another release of this library: build the one of the osik_jax that saved it");
  if (const Json* missing = section.find("missing")) refuse("the compiled core does not have " + missing->text);
  return section;
}

// The nearest rotation, in place, as exact_rotation has it; returns whether the matrix is that near to one.
bool make_exact(double* m) {
  auto M = Mat3<double>::of(m);
  double product[9], residual = 0;
  (M * M.transposed()).put(product);
  for (int i = 0; i < 9; ++i) residual = larger(residual, fabs(product[i] - (i % 4 == 0)));
  if (residual > square(1 + ROUNDED) - 1 || !(inner(cross(M.a, M.b), M.c) > 0)) return false;
  for (int k = 0; k < 4 && residual > EXACT; ++k) {  // Newton and Schulz
    const Mat3<double> G = M * (M.transposed() * M);
    M = {1.5 * M.a - 0.5 * G.a, 1.5 * M.b - 0.5 * G.b, 1.5 * M.c - 0.5 * G.c};
  }
  M.put(m);
  return true;
}
}  // namespace

struct osik_controller {
  std::vector<Input> inputs;  // q, then the targets
  std::vector<std::string> names[3];
  std::vector<double> initial[3], numbers, constants, result, moved;
  std::vector<int> layout, manifold, integers;
  Manifold along;
  StepSizes sizes;
  std::unique_ptr<Step> step;
  const double* arrays[1];
  double dt;

  explicit osik_controller(const Json& section) {
    numbers = section["numbers"].numbers<double>(), constants = section["constants"].numbers<double>();
    names[OSIK_Q] = section["q"].texts(), names[OSIK_VELOCITY] = section["velocity"].texts();
    layout = section["layout"].numbers<int>(), dt = section["dt"].number;
    const StepLayout laid_out(layout.data(), int(layout.size()));
    sizes = laid_out.s;
    LayoutCheck(laid_out, numbers.size(), constants.size());
    require(dt > 0 && dt <= LARGEST_DOUBLE, "dt");
    require(int(names[OSIK_Q].size()) == sizes.given && int(names[OSIK_VELOCITY].size()) == sizes.nv, "names");
    for (const Json& one : section["inputs"].items) {
      const auto place = one.numbers<int>();
      const Input input{one.items.at(0).text, place.at(1), place.at(2), place.at(3) != 0};
      const int vector = inputs.empty() ? OSIK_Q : OSIK_TARGETS;
      require(input.first >= 0 && input.count > 0 && size_t(input.first) + input.count <= numbers.size(), "inputs");
      require((!input.is_rotation || input.count == 9) && (vector == OSIK_TARGETS || input.count == sizes.given), "inputs");
      inputs.push_back(input);
      if (vector == OSIK_TARGETS) names[vector].insert(names[vector].end(), input.count, input.name);
      for (int i = 0; i < input.count; ++i) initial[vector].push_back(numbers.at(input.first + i));
    }
    require(!inputs.empty(), "inputs");
    std::vector<int> counts;
    for (const Json& part : section["manifold"].items) {
      counts.push_back(int(part.items.size()));
      for (int entry : part.numbers<int>()) manifold.push_back(entry);
    }
    require(counts.size() == 4 && counts[0] == counts[1] && counts[2] == counts[3], "manifold");
    along = {counts[0], counts[2], manifold.data(), manifold.data() + 2 * counts[0]};
    require_within(along.scalar, counts[0], 0, sizes.given, "manifold");
    require_within(along.scalar + counts[0], counts[0], 0, sizes.nv, "manifold");
    require_within(along.quaternion, counts[2], 0, sizes.given - 3, "manifold");
    require_within(along.quaternion + counts[2], counts[2], 0, sizes.nv - 2, "manifold");
    step = std::make_unique<Step>(layout.data(), int(layout.size()));
    // status, iterations and factorizations, then labels of the active set
    integers.resize(3 + sizes.labels());
    result.resize(sizes.nv + 2 + 2 * sizes.rows), moved.resize(sizes.nv), initial[OSIK_VELOCITY].resize(sizes.nv);
    arrays[0] = numbers.data();
  }
  // Copy q and the targets to their places, NaN where they are no configuration or rotation; returns whether none is NaN.
  bool take(const double* q, const double* targets) {
    bool clean = true;
    for (const Input& input : inputs) {
      const double*& from = &input == inputs.data() ? q : targets;
      double* to = numbers.data() + input.first;
      bool valid = true;
      for (int i = 0; i < input.count; ++i) to[i] = from[i], valid &= to[i] == to[i];
      from += input.count;
      for (int k = 0; k < along.quaternions && &input == inputs.data(); ++k) {
        const double* w = to + along.quaternion[k];
        valid &= w[0] * w[0] + w[1] * w[1] + w[2] * w[2] + w[3] * w[3] > SHORTEST;
      }
      if (!valid || (input.is_rotation && !make_exact(to))) to[0] = NAN, clean = false;
    }
    return clean;
  }
};

osik_controller* osik_load(const char* path, char* message, size_t size) {
  try {
    return new osik_controller(read_section(path));
  } catch (const std::exception& problem) {
    if (message && size) std::snprintf(message, size, "%s: %s", path, problem.what());
  }
  return nullptr;
}

void osik_free(osik_controller* controller) { delete controller; }

int osik_size(const osik_controller* c, osik_vector vector) { return int(c->names[vector].size()); }

const char* osik_name(const osik_controller* c, osik_vector vector, int index) {
  return index >= 0 && index < osik_size(c, vector) ? c->names[vector][index].c_str() : nullptr;
}

int osik_find(const osik_controller* c, osik_vector vector, const char* name) {
  const auto& names = c->names[vector];
  const auto found = std::find(names.begin(), names.end(), name);
  return found == names.end() ? -1 : int(found - names.begin());
}

void osik_initial(const osik_controller* c, osik_vector vector, double* values) {
  std::copy(c->initial[vector].begin(), c->initial[vector].end(), values);
}

double osik_period(const osik_controller* c) { return c->dt; }

osik_status osik_step(osik_controller* c, const double* q, const double* targets, double* velocity) {
  const bool clean = c->take(q, targets ? targets : c->initial[OSIK_TARGETS].data());
  // without the last step's active set, which would save little time and make the answer depend on earlier steps: by 1e-8
  // where targets are out of reach
  c->step->take({c->constants.data(), c->arrays, &APART, 1, nullptr, nullptr}, {c->result.data(), c->integers.data()},
                clean);
  std::copy_n(c->result.begin(), c->sizes.nv, velocity);
  return osik_status(c->integers[0]);
}

void osik_integrate(osik_controller* c, const double* q, const double* velocity, double* next) {
  for (int j = 0; j < c->sizes.nv; ++j) c->moved[j] = c->dt * velocity[j];
  c->along.integrate(q, c->moved.data(), next);
}
