// The flight kernels of one SIMD level, without fused products and sums: all levels give bitwise
// identical flights.
#include "flight/flight.hpp"

#include "flight/quadrotor.hpp"

namespace splatpilot::SIMD_LEVEL {

using Lanes = DoubleRegister;
using Lanes3 = Vector3<Lanes>;

constexpr double kTiny = 1e-12;  // Keeps directions finite where a length is zero.

SP_INLINE Lanes clip(const Lanes& a, const Lanes& low, const Lanes& high) {
  return min(max(a, low), high);
}

SP_INLINE Lanes magnitude(const Lanes& a) { return max(a, -a); }

SP_INLINE Lanes3 unit(const Lanes3& a) {
  const Lanes scale = 1.0 / max(sqrt(dot(a, a)), broadcast(kTiny));
  return scale * a;
}

// Absolute error below 5e-16: a polynomial fitted to |y / x| <= sqrt(2) - 1 after two reductions.
SP_INLINE Lanes arctan2(const Lanes& y, const Lanes& x) {
  const Lanes up = magnitude(y), along = magnitude(x);
  const Lanes low = min(up, along), high = max(max(up, along), broadcast(1e-300));
  const auto beyond = low > 0.41421356237309503 * high;
  const Lanes numerator = beyond ? low - high : low;
  const Lanes t = numerator / (beyond ? low + high : high), s = t * t;
  Lanes p = broadcast(-0.017805397205419446);
  p = p * s + 0.03796525745386593;
  p = p * s - 0.05035102456601552;
  p = p * s + 0.05846878297330872;
  p = p * s - 0.06662951813629191;
  p = p * s + 0.07692045330902225;
  p = p * s - 0.09090896809064027;
  p = p * s + 0.11111110744919658;
  p = p * s - 0.14285714279250245;
  p = p * s + 0.19999999999940893;
  p = p * s - 0.3333333333333312;
  Lanes angle = t + t * (s * p);
  angle = beyond ? angle + 0.7853981633974483 : angle;
  angle = up > along ? 1.5707963267948966 - angle : angle;
  angle = x < 0.0 ? 3.141592653589793 - angle : angle;
  return y < 0.0 ? -angle : angle;
}

// Thrust over mass and body rates, see `flatness_command`.
template <typename Parameter>
SP_INLINE void flatness_command(const Lanes* state, const Lanes3& a_WB, const Lanes3& motion_W,
                                const Parameter& parameter, Lanes* command) {
  const Lanes inverse = 1.0 / max(sqrt(state[6] * state[6] + state[7] * state[7] +
                                       state[8] * state[8] + state[9] * state[9]),
                                  broadcast(kTiny));
  const Lanes w = state[6] * inverse, x = state[7] * inverse, y = state[8] * inverse,
              z = state[9] * inverse;
  const Lanes3 x_B = {1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)};
  const Lanes3 y_B = {2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)};
  const Lanes3 z_B = {2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)};

  const Lanes drag = parameter(kDrag);
  Lanes3 f = {a_WB.x + drag * state[3], a_WB.y + drag * state[4], a_WB.z + drag * state[5]};
  const Lanes lowest = parameter(kControlMinThrust), highest = parameter(kControlMaxThrust);
  f.z = max(f.z + parameter(kGravity), lowest);
  const Lanes widest = f.z * parameter(kMaxTiltTangent), one = broadcast(1.0);
  const Lanes shrink = min(widest / sqrt(f.x * f.x + f.y * f.y + kTiny), one);
  f = {shrink * f.x, shrink * f.y, f.z};
  f = min(highest / sqrt(dot(f, f)), one) * f;

  // The axes of the desired body D: its x axis, seen from above, lies along the motion.
  const Lanes square = motion_W.x * motion_W.x + motion_W.y * motion_W.y;
  const Lanes horizontal = sqrt(square);
  const auto moves = horizontal > 0.0;
  const Lanes per_speed = 1.0 / (moves ? horizontal : one);
  const Lanes cos = moves ? motion_W.x * per_speed : one;
  const Lanes sin = motion_W.y * per_speed;
  const Lanes yaw_speed = parameter(kYawSpeed);
  const Lanes strength = min(square / (yaw_speed * yaw_speed), one);
  const Lanes3 z_D = unit(f);
  const Lanes3 x_D = unit(Lanes3{cos * z_D.z, sin * z_D.z, -sin * z_D.y - cos * z_D.x});
  const Lanes z1 = dot(x_B, z_D), z2 = dot(y_B, z_D) - kTiny, z3 = dot(z_B, z_D);
  const Lanes x1 = dot(x_B, x_D), x2 = dot(y_B, x_D), x3 = dot(z_B, x_D);

  // First tilt by `angle` about n, then yaw.
  const Lanes sine = sqrt(z1 * z1 + z2 * z2 + kTiny * kTiny * kTiny), per_sine = 1.0 / sine;
  const Lanes angle = arctan2(sine, z3);
  const Lanes n1 = -z2 * per_sine, n2 = z1 * per_sine;
  const Lanes rate = min(parameter(kTiltGain) * angle, parameter(kControlMaxTiltRate));
  const Lanes per_length = 1.0 / sqrt(sine * sine + z3 * z3);
  const Lanes c = z3 * per_length, s = sine * per_length;
  const Lanes onto_n = (n1 * x1 + n2 * x2) * (1.0 - c);
  const Lanes ahead = c * x1 - s * n2 * x3 + onto_n * n1;
  const Lanes left = c * x2 + s * n1 * x3 + onto_n * n2;
  const Lanes yaw = parameter(kYawGain) * strength * arctan2(left, ahead);
  const Lanes max_yaw = parameter(kControlMaxYawRate);
  command[0] = clip(dot(f, z_B), lowest, highest);
  command[1] = rate * n1;
  command[2] = rate * n2;
  command[3] = clip(yaw, -max_yaw, max_yaw);
}

template <typename Parameter>
SP_INLINE void update_controller(ActionKind kind, const Lanes* state, const Lanes* action,
                                 const Parameter& parameter, Lanes* command) {
  if (kind == ActionKind::kCommand) {
    for (int k = 0; k < 4; ++k) command[k] = action[k];
    return;
  }
  const Lanes3 v_WB = {state[3], state[4], state[5]};
  Lanes3 a_WB = {action[0], action[1], action[2]}, motion_W = v_WB;
  if (kind == ActionKind::kVelocity) {  // see `tracking_acceleration`
    a_WB = Lanes(1.0 / parameter(kResponseTime)) * (a_WB - v_WB);
    const Lanes size = sqrt(max(dot(a_WB, a_WB), broadcast(kTiny)));
    a_WB = min(parameter(kMaxAcceleration) / size, broadcast(1.0)) * a_WB;
  } else if (kind == ActionKind::kWaypoint) {  // see `reaching_acceleration`
    const Lanes lookahead = parameter(kLookahead), per_time = 1.0 / lookahead;
    const Lanes3 away = a_WB - Lanes3{state[0], state[1], state[2]};
    motion_W = per_time * away;
    a_WB = Lanes(2.0 * per_time * per_time) * (away - lookahead * v_WB);
  }
  flatness_command(state, a_WB, motion_W, parameter, command);
}

// The coefficients of Dormand and Prince, of Drake's RungeKutta5Integrator.
constexpr double kStages[6][6] = {
    {1.0 / 5},
    {3.0 / 40, 9.0 / 40},
    {44.0 / 45, -56.0 / 15, 32.0 / 9},
    {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
    {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656},
    {35.0 / 384, 0.0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84}};

template <int kStage, int kSize>
SP_INLINE void combine(const Lanes* start, const Lanes (*slopes)[kStateSize + 1], double step,
                       Lanes* state) {
  for (int i = 0; i < kSize; ++i) {
    Lanes sum = start[i];
    SP_EACH_OF(kStage + 1, j) {
      if (kStages[kStage][j] != 0.0) sum = sum + (kStages[kStage][j] * step) * slopes[j][i];
    }
    state[i] = sum;
  }
}

template <bool kActuated, typename Parameter>
SP_INLINE void integrate(Lanes* state, const Lanes* command, const Parameter& parameter,
                         double step) {
  constexpr int kSize = kActuated ? kStateSize + 1 : kStateSize;
  Lanes start[kSize], slopes[6][kStateSize + 1];
  for (int i = 0; i < kSize; ++i) start[i] = state[i];
  const auto slope = [&](Lanes* derivatives) {
    if constexpr (kActuated) {
      actuated_derivatives(state, command, parameter, derivatives);
    } else {
      const Lanes* none = nullptr;
      quadrotor_derivatives(state, command, parameter(kDrag), parameter(kRateGain),
                            parameter(kGravity), none, none, derivatives);
    }
  };
  slope(slopes[0]);
  combine<0, kSize>(start, slopes, step, state);
  slope(slopes[1]);
  combine<1, kSize>(start, slopes, step, state);
  slope(slopes[2]);
  combine<2, kSize>(start, slopes, step, state);
  slope(slopes[3]);
  combine<3, kSize>(start, slopes, step, state);
  slope(slopes[4]);
  combine<4, kSize>(start, slopes, step, state);
  slope(slopes[5]);
  combine<5, kSize>(start, slopes, step, state);
}

template <bool kActuated>
static void advance_pack(VehiclePack& pack, ActionKind kind, double step, int steps) {
  constexpr int kSize = kActuated ? kStateSize + 1 : kStateSize;
  for (int lane = 0; lane < kPackVehicles; lane += kDoubleLanes) {
    const auto parameter = [&](int row) { return load(pack.parameters[row] + lane); };
    Lanes state[kSize], action[4], command[4];
    for (int i = 0; i < kSize; ++i) state[i] = load(pack.state[i] + lane);
    for (int k = 0; k < 4; ++k) action[k] = load(pack.action[k] + lane);
    update_controller(kind, state, action, parameter, command);
    for (int i = 0; i < steps; ++i) integrate<kActuated>(state, command, parameter, step);
    for (int i = 0; i < kSize; ++i) store(pack.state[i] + lane, state[i]);
  }
}

static void advance(VehiclePack& pack, ActionKind kind, bool actuated, double step, int steps) {
  if (actuated) return advance_pack<true>(pack, kind, step, steps);
  advance_pack<false>(pack, kind, step, steps);
}

static void command(ActionKind kind, const double* state, const double* action,
                    const double* parameters, double* command) {
  Lanes states[kStateSize], actions[4], commands[4];
  for (int i = 0; i < kStateSize; ++i) states[i] = broadcast(state[i]);
  const int size = kind == ActionKind::kCommand ? 4 : 3;
  for (int k = 0; k < size; ++k) actions[k] = broadcast(action[k]);
  const auto parameter = [&](int row) { return broadcast(parameters[row]); };
  update_controller(kind, states, actions, parameter, commands);
  for (int k = 0; k < 4; ++k) command[k] = commands[k][0];
}

extern const FlightKernels kFlightKernels;
const FlightKernels kFlightKernels = {advance, command};

}  // namespace splatpilot::SIMD_LEVEL
