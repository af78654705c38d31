// Dynamics of quadrotors, of doubles or of registers of them.
#pragma once

#include "core/vectors.hpp"
#include "flight/flight.hpp"

namespace splatpilot::SIMD_LEVEL {

SP_INLINE double min(double a, double b) { return a < b ? a : b; }
SP_INLINE double max(double a, double b) { return a > b ? a : b; }

constexpr double kTinySquare = 1e-12;
constexpr double kNormGain = 5.0;  // [1/s]

// The derivative of the 13 numbers of the state, see `component_derivatives`.
template <typename T>
SP_INLINE void quadrotor_derivatives(const T* state, const T* command, const T& drag,
                                     const T& rate_gain, const T& gravity, const T* wind,
                                     const T* disturbance, T* derivatives) {
  const T *v = state + 3, *w = state + 10;
  const T qw = state[6], qx = state[7], qy = state[8], qz = state[9];
  const T norm2 = qw * qw + qx * qx + qy * qy + qz * qz;
  const T thrust = command[0] / norm2;
  const T pull = kNormGain * (1.0 - norm2);
  const T lift[3] = {thrust * (2.0 * (qx * qz + qw * qy)), thrust * (2.0 * (qy * qz - qw * qx)),
                     thrust * (qw * qw - qx * qx - qy * qy + qz * qz)};
  for (int k = 0; k < 3; ++k) {
    derivatives[k] = v[k];
    derivatives[3 + k] = lift[k] - drag * (wind ? v[k] - wind[k] : v[k]);
    if (k == 2) derivatives[5] = derivatives[5] - gravity;
    if (disturbance) derivatives[3 + k] = derivatives[3 + k] + disturbance[k];
    derivatives[10 + k] = (command[1 + k] - w[k]) * rate_gain;
  }
  derivatives[6] = 0.5 * (-qx * w[0] - qy * w[1] - qz * w[2]) + pull * qw;
  derivatives[7] = 0.5 * (qw * w[0] + qy * w[2] - qz * w[1]) + pull * qx;
  derivatives[8] = 0.5 * (qw * w[1] + qz * w[0] - qx * w[2]) + pull * qy;
  derivatives[9] = 0.5 * (qw * w[2] + qx * w[1] - qy * w[0]) + pull * qz;
}

// Rotates a vector by the quaternion (w, q), where `scale` is 2 / (w^2 + q^2).
template <typename T>
SP_INLINE Vector3<T> rotate(const T& scale, const T& w, const Vector3<T>& q, const Vector3<T>& a) {
  const Vector3<T> once = cross(q, a), twice = cross(q, once);
  return a + scale * (w * once + twice);
}

// The derivative of the state of vehicles with lags, limits and drag in the body's axes, see
// `actuated_derivatives`. `parameter` returns a row's registers.
template <typename T, typename Parameter>
SP_INLINE void actuated_derivatives(const T* state, const T* command, const Parameter& parameter,
                                    T* derivatives) {
  const T wind[3] = {parameter(kWind), parameter(kWind + 1), parameter(kWind + 2)};
  const Vector3<T> v = {state[3] - wind[0], state[4] - wind[1], state[5] - wind[2]};
  const Vector3<T> q = {state[7], state[8], state[9]};
  const T w = state[6], scale = 2.0 / (w * w + dot(q, q));
  const T speed = sqrt(dot(v, v) + kTinySquare);
  const Vector3<T> v_B = rotate(scale, T(-w), q, v);
  const auto drag = [&](int k, const T& along) {
    return -(parameter(kRotorDrag + k) + parameter(kQuadraticDrag + k) * speed) * along;
  };
  const Vector3<T> a_W =
      rotate(scale, w, q, Vector3<T>{drag(0, v_B.x), drag(1, v_B.y), drag(2, v_B.z)});
  const T added[3] = {a_W.x, a_W.y, a_W.z};

  const T tilt = parameter(kMaxTiltRate), yaw = parameter(kMaxYawRate);
  const T thrust_cmd = max(parameter(kMinThrust), min(command[0], parameter(kMaxThrust)));
  const T motor_gain = parameter(kMotorGain);
  const T thrust = motor_gain > 0.0 ? state[kLaggedThrust] : thrust_cmd;
  const T limited[4] = {parameter(kThrustScale) * thrust, max(-tilt, min(command[1], tilt)),
                        max(-tilt, min(command[2], tilt)), max(-yaw, min(command[3], yaw))};
  quadrotor_derivatives(state, limited, parameter(kDrag), parameter(kRateGain), parameter(kGravity),
                        wind, added, derivatives);
  derivatives[12] = (limited[3] - state[12]) * parameter(kYawRateGain);
  derivatives[kLaggedThrust] = (thrust_cmd - state[kLaggedThrust]) * motor_gain;
}

}  // namespace splatpilot::SIMD_LEVEL
