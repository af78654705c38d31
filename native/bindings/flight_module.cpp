// Python bindings of flights of many quadrotors, and of distances in their worlds.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <mutex>
#include <optional>
#include <utility>
#include <variant>
#include <vector>

#include "bindings/casting_bindings.hpp"
#include "flight/flight.hpp"

// The distances and derivatives below are compiled for every machine.
#define SIMD_LEVEL baseline
#include "flight/distance_worlds.hpp"
#include "flight/quadrotor.hpp"

namespace splatpilot {
namespace {

using DoubleRows = Doubles<nb::shape<-1, kShapeSize>>;
using Kinds = Array<const uint8_t, nb::ndim<1>>;
using VoxelStates = Array<const uint8_t, nb::ndim<3>>;
using FieldStates = Written<uint8_t, nb::ndim<1>>;
using Numbers = Doubles<nb::ndim<1>>;
using Rows = Doubles<nb::ndim<2>>;
using Packs = Doubles<nb::shape<-1, kFlightParameters, kPackVehicles>>;
using Flags = Array<const bool, nb::ndim<1>>;
using Counts = Written<int32_t, nb::ndim<1>>;

const std::vector<std::string> kParameterNames = {
    "drag",         "rate_gain",    "yaw_rate_gain",    "gravity",       "motor_gain",
    "thrust_scale", "min_thrust",   "max_thrust",       "max_tilt_rate", "max_yaw_rate",
    "rotor_drag_x", "rotor_drag_y", "rotor_drag_z",     "quadratic_x",   "quadratic_y",
    "quadratic_z",  "wind_x",       "wind_y",           "wind_z",        "lookahead",
    "control_min",  "control_max",  "max_tilt_tangent", "tilt_gain",     "control_tilt",
    "yaw_gain",     "control_yaw",  "yaw_speed",        "response_time", "max_acceleration"};

// The distance fields of worlds, whose numbers are those of their addition.
class FlightWorlds {
 public:
  size_t add_shapes(const DoubleRows& shapes, const Kinds& kinds, const Point& lower_W,
                    const Point& upper_W) {
    require_rows(shapes.shape(0), "shapes and kinds differ in number", kinds);
    for (size_t i = 0; i < kinds.size(); ++i) {
      require(kinds.data()[i] < kShapeKinds, "unknown kind of shape");
    }
    for (int k = 0; k < 3; ++k) {
      const double span = upper_W.data()[k] - lower_W.data()[k];
      require(span > 0.0 && std::isfinite(span), "upper_W must be above lower_W, and finite");
    }
    const nb::gil_scoped_release release;
    worlds_.emplace_back(ShapeBox({shapes.data(), shapes.data() + shapes.size()},
                                  {kinds.data(), kinds.data() + kinds.size()}, lower_W.data(),
                                  upper_W.data()));
    return worlds_.size() - 1;
  }

  size_t add_grid(const Grid& distances, const VoxelStates& states, const Point& lower_W,
                  const Point& upper_W, double voxel_size, bool occupied_outside) {
    for (int k = 0; k < 3; ++k) {
      require(states.shape(k) == distances.shape(k), "distances and states differ in shape");
    }
    GridBox box{{voxel_grid(distances, lower_W, voxel_size), {}, occupied_outside}, states.data()};
    std::copy_n(upper_W.data(), 3, box.field.upper_W);
    worlds_.emplace_back(box);
    grids_.emplace_back(distances, states);
    return worlds_.size() - 1;
  }

  size_t size() const { return worlds_.size(); }

  SpaceSample sample(int64_t world, const double* p, double* gradient) const {
    return std::visit([&](const auto& box) { return box.sample(p, gradient); }, at(world));
  }

  bool is_clear(int64_t world, const double* p, double distance, double moved,
                double radius) const {
    return std::visit([&](const auto& box) { return box.is_clear(p, distance, moved, radius); },
                      at(world));
  }

  void query(const QueryPoints& p, const Indices& world, const Distances& distances,
             const FieldStates& states, const std::optional<Gradients>& gradients) const {
    const size_t count = p.shape(0);
    require_rows(count, "points, distances and states differ in number", distances, states);
    require(!gradients || gradients->shape(0) == count, "points and gradients differ in number");
    require_worlds(world, count, size());
    const nb::gil_scoped_release release;
    for (size_t i = 0; i < count; ++i) {
      double* gradient = gradients ? gradients->data() + 3 * i : nullptr;
      const SpaceSample at = sample(world.data()[i], p.data() + 3 * i, gradient);
      distances.data()[i] = at.distance;
      states.data()[i] = at.state;
    }
  }

 private:
  const std::variant<ShapeBox, GridBox>& at(int64_t world) const {
    return worlds_[static_cast<size_t>(world)];
  }

  std::vector<std::variant<ShapeBox, GridBox>> worlds_;
  std::vector<std::pair<Grid, VoxelStates>> grids_;  // kept alive
};

// Ends of flights, in the order in which the first that holds is the outcome.
enum End : uint8_t { kInFlight, kCollision, kLeftVolume, kGoal, kTimeout };

// Vehicles in worlds; rows are those of N vehicles.
struct Vehicles {
  Written<double, nb::shape<-1, kStateSize>> states;
  Written<double, nb::ndim<1>> thrusts;
  Packs parameters;  // by packs of vehicles
  Indices world;
  QueryPoints goals;
  Numbers radii, goal_radii;
  Counts remaining;
  Distances distances;
  FieldStates field_states, ends;

  size_t count() const { return states.shape(0); }
};

ActionKind action_kind(const std::string& kind) {
  if (kind == "command") return ActionKind::kCommand;
  if (kind == "acceleration") return ActionKind::kAcceleration;
  if (kind == "velocity") return ActionKind::kVelocity;
  require(kind == "waypoint", "actions are commands, accelerations, velocities or waypoints");
  return ActionKind::kWaypoint;
}

class FlightThreads {
 public:
  FlightThreads(int threads, const std::string& simd)
      : kernels_(*kernels(simd).flight), pool_(checked_threads(threads)) {}

  void advance(const FlightWorlds& worlds, const Vehicles& vehicles, const std::string& kind,
               const Rows& actions, const Rows& earlier, const Counts& delays, const Flags& flying,
               bool actuated, int periods, double step, int steps) {
    const size_t count = vehicles.count();
    require_rows(count, "vehicles, actions, delays and flags differ in number", actions, earlier,
                 delays, flying);
    const ActionKind action = action_kind(kind);
    const size_t size = action == ActionKind::kCommand ? 4 : 3;
    require(actions.shape(1) == size && earlier.shape(1) == size,
            "actions have 4 numbers if they are commands, else 3");
    require(periods >= 1 && steps >= 1 && step > 0.0, "periods, steps and step must be > 0");
    require_worlds(vehicles.world, count, worlds.size());
    const nb::gil_scoped_release release;
    const std::scoped_lock lock(mutex_);
    pool_.for_each((count + kPackVehicles - 1) / kPackVehicles, [&](size_t task) {
      VehiclePack pack;
      const size_t first = task * kPackVehicles;
      const int lanes = static_cast<int>(std::min<size_t>(kPackVehicles, count - first));
      const auto vehicle = [&](int lane) { return first + static_cast<size_t>(lane); };
      load(vehicles, first, lanes, pack);
      const auto act = [&](const Rows& rows, int lane) {
        for (size_t k = 0; k < 4; ++k) {
          pack.action[k][lane] = k < size ? rows.data()[vehicle(lane) * size + k] : 0.0;
        }
      };
      uint32_t live = 0;
      for (int lane = 0; lane < lanes; ++lane) {
        act(delays.data()[vehicle(lane)] > 0 ? earlier : actions, lane);
        live |= static_cast<uint32_t>(flying.data()[vehicle(lane)]) << lane;
      }
      for (int lane = lanes; lane < kPackVehicles; ++lane) {
        for (size_t k = 0; k < 4; ++k) pack.action[k][lane] = pack.action[k][0];
      }
      for (int period = 0; period < periods && live; ++period) {
        for (int lane = 0; period > 0 && lane < lanes; ++lane) {
          if (delays.data()[vehicle(lane)] == period) act(actions, lane);
        }
        kernels_.advance(pack, action, actuated, step, steps);
        for (uint32_t bits = live; bits; bits &= bits - 1u) {
          const int lane = __builtin_ctz(bits);
          const bool last = period + 1 == periods;
          const bool ended = finish_period(worlds, vehicles, vehicle(lane), pack, lane, last);
          if (ended) live &= ~(1u << lane);
          if (ended || last) store(vehicles, vehicle(lane), pack, lane);
        }
      }
    });
  }

 private:
  // Lanes without a vehicle repeat the first.
  static void load(const Vehicles& vehicles, size_t first, int lanes, VehiclePack& pack) {
    constexpr size_t kSize = kFlightParameters * kPackVehicles;
    std::copy_n(vehicles.parameters.data() + first / kPackVehicles * kSize, kSize,
                pack.parameters[0]);
    for (int lane = 0; lane < kPackVehicles; ++lane) {
      const size_t n = first + static_cast<size_t>(lane < lanes ? lane : 0);
      for (size_t i = 0; i < kStateSize; ++i) {
        pack.state[i][lane] = vehicles.states.data()[n * kStateSize + i];
      }
      pack.state[kLaggedThrust][lane] = vehicles.thrusts.data()[n];
    }
  }

  static void store(const Vehicles& vehicles, size_t n, const VehiclePack& pack, int lane) {
    for (size_t i = 0; i < kStateSize; ++i) {
      vehicles.states.data()[n * kStateSize + i] = pack.state[i][lane];
    }
    vehicles.thrusts.data()[n] = pack.state[kLaggedThrust][lane];
  }

  // Writes the end of a vehicle, its remaining periods and, at its end and at the `last` period,
  // distance and state of space. Returns if it ended.
  static bool finish_period(const FlightWorlds& worlds, const Vehicles& vehicles, size_t n,
                            const VehiclePack& pack, int lane, bool last) {
    double p[3], to_goal = 0.0, moved = 0.0;
    for (size_t k = 0; k < 3; ++k) {
      p[k] = pack.state[k][lane];
      to_goal += square(vehicles.goals.data()[3 * n + k] - p[k]);
      // The state and the distance of the beginning are still there.
      moved += square(vehicles.states.data()[n * kStateSize + k] - p[k]);
    }
    const bool at_goal = std::sqrt(to_goal) - vehicles.goal_radii.data()[n] <= 0.0;
    const bool is_late = --vehicles.remaining.data()[n] <= 0;
    const int64_t world = vehicles.world.data()[n];
    const double radius = vehicles.radii.data()[n];
    double& distance = vehicles.distances.data()[n];
    if (!last && !at_goal && !is_late &&
        worlds.is_clear(world, p, distance, std::sqrt(moved), radius)) {
      return false;
    }
    const SpaceSample at = worlds.sample(world, p, nullptr);
    End end = kInFlight;
    if (at.distance - radius <= 0.0) {
      end = kCollision;
    } else if (at.state >= kUnknown) {
      end = kLeftVolume;
    } else if (at_goal) {
      end = kGoal;
    } else if (is_late) {
      end = kTimeout;
    }
    if (last || end != kInFlight) {
      distance = at.distance;
      vehicles.field_states.data()[n] = at.state;
    }
    vehicles.ends.data()[n] = end;
    return end != kInFlight;
  }

  static double square(double x) { return x * x; }

  const FlightKernels& kernels_;
  ThreadPool pool_;
  std::mutex mutex_;
};

void command(const std::string& kind, const Doubles<nb::shape<kStateSize>>& state,
             const Numbers& action, const Doubles<nb::shape<kFlightParameters>>& parameters,
             const Written<double, nb::shape<4>>& command) {
  static const FlightKernels& kernels_of_machine = *kernels("").flight;
  const ActionKind known = action_kind(kind);
  require(action.size() == (known == ActionKind::kCommand ? 4 : 3),
          "actions have 4 numbers if they are commands, else 3");
  kernels_of_machine.command(known, state.data(), action.data(), parameters.data(), command.data());
}

using Vector3d = Doubles<nb::shape<3>>;

void derivatives(const Doubles<nb::shape<kStateSize>>& state, const Doubles<nb::shape<4>>& command,
                 double drag, double rate_time_constant, double gravity,
                 const Written<double, nb::shape<kStateSize>>& rates,
                 const std::optional<Vector3d>& wind, const std::optional<Vector3d>& disturbance) {
  SIMD_LEVEL::quadrotor_derivatives(state.data(), command.data(), drag, 1.0 / rate_time_constant,
                                    gravity, wind ? wind->data() : nullptr,
                                    disturbance ? disturbance->data() : nullptr, rates.data());
}

// The state has the charge, whose rate is not written, before the thrust over mass.
void actuated(const Doubles<nb::shape<kStateSize + 2>>& state, const Doubles<nb::shape<4>>& command,
              const Doubles<nb::shape<kFlightParameters>>& parameters,
              const Written<double, nb::shape<kStateSize + 2>>& rates) {
  double lagged[kStateSize + 1], derivatives[kStateSize + 1];
  std::copy_n(state.data(), kStateSize, lagged);
  lagged[kLaggedThrust] = state.data()[kStateSize + 1];
  const auto parameter = [&](int row) { return parameters.data()[row]; };
  SIMD_LEVEL::actuated_derivatives(lagged, command.data(), parameter, derivatives);
  std::copy_n(derivatives, kStateSize, rates.data());
  rates.data()[kStateSize + 1] = derivatives[kLaggedThrust];
}

}  // namespace

void bind_flight(nb::module_& m) {
  m.attr("FLIGHT_PARAMETERS") = nb::cast(kParameterNames);
  nb::class_<FlightWorlds>(m, "FlightWorlds", "The distance fields of worlds.")
      .def(nb::init<>())
      .def("__len__", &FlightWorlds::size)
      .def("add_shapes", &FlightWorlds::add_shapes, nb::kw_only(), "shapes"_a, "kinds"_a,
           "lower_W"_a, "upper_W"_a,
           "Adds a world of analytic shapes, see `ShapeWorlds`; returns its number.")
      .def("add_grid", &FlightWorlds::add_grid, nb::kw_only(), "distances"_a, "states"_a,
           "lower_W"_a, "upper_W"_a, "voxel_size"_a, "occupied_outside"_a,
           "Adds a world of a grid, see `grid_distances`; returns its number.")
      .def("query", &FlightWorlds::query, nb::kw_only(), "p_WQ"_a, "world"_a, "distances"_a,
           "states"_a, "gradients"_a = nb::none(),
           "Writes the distances (N,), their gradients (N, 3) and the states of space (N,).");
  nb::class_<Vehicles>(m, "Vehicles",
                       "Arrays of N vehicles, which `FlightThreads` updates. Parameters are in "
                       "packs\n(ceil(N / 16), len(FLIGHT_PARAMETERS), 16).")
      .def(
          "__init__",
          [](Vehicles* self, const Written<double, nb::shape<-1, kStateSize>>& states,
             const Written<double, nb::ndim<1>>& thrusts, const Packs& parameters,
             const Indices& world, const QueryPoints& goals, const Numbers& radii,
             const Numbers& goal_radii, const Counts& remaining, const Distances& distances,
             const FieldStates& field_states, const FieldStates& ends) {
            const size_t n = states.shape(0);
            require_rows(n, "arrays of vehicles differ in length", thrusts, world, goals, radii,
                         goal_radii, remaining, distances, field_states, ends);
            require_rows((n + kPackVehicles - 1) / kPackVehicles,
                         "parameters must have packs for all vehicles", parameters);
            new (self) Vehicles{states,     thrusts,   parameters, world,        goals, radii,
                                goal_radii, remaining, distances,  field_states, ends};
          },
          nb::kw_only(), "states"_a, "thrusts"_a, "parameters"_a, "world"_a, "goals"_a, "radii"_a,
          "goal_radii"_a, "remaining"_a, "distances"_a, "field_states"_a, "ends"_a);
  nb::class_<FlightThreads>(m, "FlightThreads", "Threads without influence on flights.")
      .def(nb::init<int, const std::string&>(), "threads"_a, "simd"_a = "")
      .def(
          "advance", &FlightThreads::advance, "worlds"_a, "vehicles"_a, nb::kw_only(), "kind"_a,
          "actions"_a, "earlier"_a, "delays"_a, "flying"_a, "actuated"_a, "periods"_a, "step"_a,
          "steps"_a,
          "Flies vehicles for periods of their controllers, each of `steps` steps [s], until one\n"
          "ends: 1 collision, 2 left volume, 3 goal, 4 timeout. An action follows the earlier one\n"
          "after its delay [periods].");
  m.def("flight_command", &command, "kind"_a, "state"_a, "action"_a, "parameters"_a, "command"_a,
        "Writes the command (4,) of the controller, for parameters in the order of\n"
        "FLIGHT_PARAMETERS.");
  m.def("quadrotor_derivatives", &derivatives, "state"_a, "command"_a, "drag"_a,
        "rate_time_constant"_a, "gravity"_a, "derivatives"_a, "wind"_a = nb::none(),
        "disturbance"_a = nb::none(), "Writes the derivatives (13,) of `component_derivatives`.");
  m.def("actuated_derivatives", &actuated, "state"_a, "command"_a, "parameters"_a, "derivatives"_a,
        "Writes the derivatives (15,) of `actuated_derivatives`, without that of the charge, for\n"
        "parameters in the order of FLIGHT_PARAMETERS.");
}

}  // namespace splatpilot
