// follow CONTROLLER.json TARGET [SECONDS]: a position to reach, such as "hand.target[0]", moves on a circle in real time.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <thread>
#include <vector>

#include "osik.h"

using Clock = std::chrono::steady_clock;
using Seconds = std::chrono::duration<double>;

int main(int count, char** words) {
  if (count < 3) return std::puts("follow CONTROLLER.json TARGET [SECONDS]"), 2;
  const double seconds = count > 3 ? std::atof(words[3]) : 5.0;
  char message[400];
  osik_controller* controller = osik_load(words[1], message, sizeof message);
  if (!controller) return std::fprintf(stderr, "%s\n", message), 1;

  const double dt = osik_period(controller);
  std::vector<double> q(osik_size(controller, OSIK_Q)), v(osik_size(controller, OSIK_VELOCITY));
  std::vector<double> targets(osik_size(controller, OSIK_TARGETS));
  osik_initial(controller, OSIK_Q, q.data());  // a robot would give what its encoders say, by osik_find
  osik_initial(controller, OSIK_TARGETS, targets.data());
  const int moving = osik_find(controller, OSIK_TARGETS, words[2]);  // its first entry: x of a position
  if (moving < 0) return std::fprintf(stderr, "no target %s\n", words[2]), 1;
  const double start[2] = {targets[moving + 1], targets[moving + 2]};
  const int steps = std::max(1, int(seconds / dt));
  int failed = 0, late = 0;
  std::vector<double> took;
  took.reserve(steps);
  auto next = Clock::now();
  for (int k = 0; k < steps; ++k) {
    const double angle = 3.14159265358979 * k * dt;  // a turn in two seconds, in the plane y z, 5 cm from its centre
    targets[moving + 1] = start[0] + 0.05 * std::sin(angle);
    targets[moving + 2] = start[1] + 0.05 * (1.0 - std::cos(angle));
    const auto began = Clock::now();
    failed += osik_step(controller, q.data(), targets.data(), v.data()) != OSIK_SOLVED;
    osik_integrate(controller, q.data(), v.data(), q.data());  // a robot would be commanded q or v
    took.push_back(Seconds(Clock::now() - began).count());
    next += std::chrono::duration_cast<Clock::duration>(Seconds(dt));
    late += Clock::now() > next;
    std::this_thread::sleep_until(next);
  }
  std::sort(took.begin(), took.end());
  std::printf("%d steps of %g ms: median %.1f us, p99 %.1f us, longest %.1f us; %d not solved, %d late\n", steps, 1e3 * dt,
              1e6 * took[steps / 2], 1e6 * took[steps * 99 / 100], 1e6 * took.back(), failed, late);
  osik_free(controller);
  return failed ? 1 : 0;
}
