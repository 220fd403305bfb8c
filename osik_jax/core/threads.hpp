// Work shared out among the threads of a CPU.
#pragma once
#include <algorithm>
#include <atomic>
#include <thread>
#include <vector>

#include "xla.hpp"

namespace osik {

// Call a worker that `make` makes with each number below `count`, in threads that take `least` of them or more.
template <class Make> void in_threads(int count, int least, Make make) {
  const int most = std::max(1, int(std::thread::hardware_concurrency()));
  std::atomic<int> next{0};
  std::atomic<bool> has_failed{false};
  auto work = [&] {
    try {
      auto worker = make();
      for (int k = next++; k < count; k = next++) worker(k);
    } catch (const std::exception&) {  // no memory
      has_failed = true;
    }
  };
  std::vector<std::thread> others;
  for (int k = 1; k < std::min(most, count / least); ++k) others.emplace_back(work);
  work();
  for (auto& other : others) other.join();
  xla::Call::require(!has_failed, "the core has no memory for a search in a scene");
}
}  // namespace osik
