// Flights of many quadrotors: the state, parameters and actions of a pack of them. Plain data, as
// in types.hpp. The formulas are those of `splatpilot.systems.vehicle`, which documents them.
#pragma once

#include <cstddef>
#include <cstdint>

namespace splatpilot {

constexpr int kPackVehicles = 16;
// p_WB, v_WB, q_WB (wxyz), w_WB_B, and thrust over mass [m/s^2] behind the motors' lag.
constexpr int kStateSize = 13, kLaggedThrust = 13;

enum class ActionKind { kCommand, kAcceleration, kVelocity, kWaypoint };

// Names in the order of `FlightParameter`: of the vehicle, the controller, and the tracking of
// velocities. A gain is the inverse of a time constant, or 0 without a lag.
enum FlightParameter {
  kDrag,
  kRateGain,
  kYawRateGain,
  kGravity,
  kMotorGain,
  kThrustScale,
  kMinThrust,
  kMaxThrust,
  kMaxTiltRate,
  kMaxYawRate,
  kRotorDrag,
  kQuadraticDrag = kRotorDrag + 3,
  kWind = kQuadraticDrag + 3,
  kLookahead = kWind + 3,
  kControlMinThrust,
  kControlMaxThrust,
  kMaxTiltTangent,
  kTiltGain,
  kControlMaxTiltRate,
  kYawGain,
  kControlMaxYawRate,
  kYawSpeed,
  kResponseTime,
  kMaxAcceleration,
  kFlightParameters
};

// Structure of arrays: lane i of each row is that of vehicle i.
struct VehiclePack {
  alignas(64) double state[kStateSize + 1][kPackVehicles];
  double parameters[kFlightParameters][kPackVehicles];
  double action[4][kPackVehicles];  // of `ActionKind`; 3 but for commands
};

struct FlightKernels {
  // Updates the controller, and integrates `steps` times over `step` [s]. Vehicles that are not
  // `actuated` have none of the parameters from the motors' gain to the wind.
  void (*advance)(VehiclePack&, ActionKind, bool actuated, double step, int steps);
  // Updates the controller of one vehicle: writes its command (4).
  void (*command)(ActionKind, const double* state, const double* action, const double* parameters,
                  double* command);
};

}  // namespace splatpilot
