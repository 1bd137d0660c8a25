// Pinocchio's forward dynamics and derivatives on a model and states given as numbers, timed without Python.
// usage: pinocchio FILE time: prints lines "aba NS" and "derivatives NS", each call on the next state;
//        pinocchio FILE accelerations: prints those of all states, one a line.
#include <pinocchio/multibody.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/aba-derivatives.hpp>
#include <algorithm>
#include <ctime>
#include <cstdio>
#include <fstream>
#include <string>
#include <vector>

namespace pin = pinocchio;

// CPU time of this process: other programs on the machine do not count
double now() { return double(std::clock()) / CLOCKS_PER_SEC * 1e9; }

template <class F>
double median_ns(F &&call, int count, int rounds) {
  std::vector<double> times;
  for (int r = 0; r < rounds; ++r) {
    const double begin = now();
    for (int i = 0; i < count; ++i) call(i);
    times.push_back((now() - begin) / count);
  }
  std::sort(times.begin(), times.end());
  return times[times.size() / 2];
}

int main(int, char **argv) {
  std::ifstream in(argv[1]);
  int joints, states;
  Eigen::Vector3d gravity;
  in >> joints >> states >> gravity[0] >> gravity[1] >> gravity[2];
  pin::Model model;
  model.gravity.linear(gravity);
  for (int j = 1; j <= joints; ++j) {
    int parent;
    std::string kind;
    Eigen::Matrix3d R, I;
    Eigen::Vector3d p, c;
    double m;
    in >> parent >> kind;
    for (int k = 0; k < 9; ++k) in >> R(k / 3, k % 3);
    for (int k = 0; k < 3; ++k) in >> p[k];
    in >> m;
    for (int k = 0; k < 3; ++k) in >> c[k];
    for (int k = 0; k < 9; ++k) in >> I(k / 3, k % 3);
    const pin::SE3 placement(R, p);
    const std::string name = "j" + std::to_string(j);
    pin::JointIndex id;
    if (kind == "hinge") id = model.addJoint(parent, pin::JointModelRZ(), placement, name);
    else if (kind == "slide") id = model.addJoint(parent, pin::JointModelPZ(), placement, name);
    else if (kind == "ball") id = model.addJoint(parent, pin::JointModelSpherical(), placement, name);
    else id = model.addJoint(parent, pin::JointModelFreeFlyer(), placement, name);
    if (m > 0) model.appendBodyToJoint(id, pin::Inertia(m, c, pin::Symmetric3(I)), pin::SE3::Identity());
  }
  std::vector<Eigen::VectorXd> q(states), v(states), tau(states);
  for (int s = 0; s < states; ++s) {
    q[s].resize(model.nq), v[s].resize(model.nv), tau[s].resize(model.nv);
    for (auto *x : {&q[s], &v[s], &tau[s]})
      for (int k = 0; k < x->size(); ++k) in >> (*x)[k];
  }
  pin::Data data(model);
  if (std::string(argv[2]) == "time") {
    const auto at = [&](int i) { return i % states; };
    std::printf("aba %.3f\n", median_ns([&](int i) {
      pin::aba(model, data, q[at(i)], v[at(i)], tau[at(i)], pin::Convention::LOCAL); }, 4000, 5));
    std::printf("derivatives %.3f\n", median_ns([&](int i) {
      pin::computeABADerivatives(model, data, q[at(i)], v[at(i)], tau[at(i)]); }, 1000, 5));
    return 0;
  }
  for (int s = 0; s < states; ++s) {
    const auto &a = pin::aba(model, data, q[s], v[s], tau[s], pin::Convention::LOCAL);
    for (int k = 0; k < a.size(); ++k) std::printf("%.17g ", a[k]);
    std::printf("\n");
  }
}
