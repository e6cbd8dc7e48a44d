// Scans from standard input through IRIS LaMa: MODE TRANSLATION_M ROTATION_RAD.
//
// A line for each scan: stamp, s; odometry x, y, yaw; laser on the robot x, y, yaw; number of points, and x, y of each,
// laser frame, m. Writes a line for each: stamp, pose x, y, yaw, whether it was processed, CPU time, ms.

#include <cstdlib>
#include <ctime>
#include <functional>
#include <iomanip>
#include <iostream>
#include <memory>
#include <string>

#include <lama/graph_slam2d.h>
#include <lama/pf_slam2d.h>
#include <lama/slam2d.h>

namespace {

constexpr unsigned kParticles = 30;
constexpr unsigned kSeed = 1;
constexpr std::size_t kLeastPoints = 10;

struct Program {
  std::function<bool(const lama::PointCloudXYZ::Ptr&, const lama::Pose2D&, double)> update;
  std::function<lama::Pose2D()> pose;
};

template <typename Slam>
Program ProgramOf(const std::shared_ptr<Slam>& slam) {
  return {
      [slam](const auto& points, const auto& odometry, double stamp) {
        return slam->update(points, odometry, stamp);
      },
      [slam] { return slam->getPose(); },
  };
}

template <typename Options>
Options WithThresholds(double translation_m, double rotation_rad) {
  Options options;
  options.trans_thresh = translation_m;
  options.rot_thresh = rotation_rad;
  return options;
}

Program MakeProgram(const std::string& mode, double translation_m, double rotation_rad) {
  using lama::GraphSlam2D;
  using lama::PFSlam2D;
  using lama::Slam2D;
  if (mode == "graph") {
    auto slam = std::make_shared<GraphSlam2D>(WithThresholds<GraphSlam2D::Options>(translation_m, rotation_rad));
    slam->Init(lama::Pose2D(0.0, 0.0, 0.0));
    return ProgramOf(slam);
  }
  if (mode == "pf") {
    auto options = WithThresholds<PFSlam2D::Options>(translation_m, rotation_rad);
    options.particles = kParticles;
    options.seed = kSeed;
    auto slam = std::make_shared<PFSlam2D>(options);
    slam->setPrior(lama::Pose2D(0.0, 0.0, 0.0));
    return ProgramOf(slam);
  }
  return ProgramOf(std::make_shared<Slam2D>(WithThresholds<Slam2D::Options>(translation_m, rotation_rad)));
}

lama::PointCloudXYZ::Ptr ReadPoints() {
  double x = 0.0;
  double y = 0.0;
  double yaw = 0.0;
  std::size_t count = 0;
  std::cin >> x >> y >> yaw >> count;
  lama::PointCloudXYZ::Ptr cloud(new lama::PointCloudXYZ);
  cloud->sensor_origin_ = Eigen::Vector3d(x, y, 0.0);
  cloud->sensor_orientation_ = Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ());
  for (std::size_t i = 0; i < count; ++i) {
    std::cin >> x >> y;
    cloud->points.emplace_back(x, y, 0.0);
  }
  return cloud;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 4) {
    std::cerr << "usage: lama_driver slam2d|graph|pf TRANSLATION_M ROTATION_RAD\n";
    return 2;
  }
  std::ios::sync_with_stdio(false);
  const Program program = MakeProgram(argv[1], std::atof(argv[2]), std::atof(argv[3]));
  std::cout << std::setprecision(17);
  double stamp = 0.0;
  double x = 0.0;
  double y = 0.0;
  double yaw = 0.0;
  while (std::cin >> stamp >> x >> y >> yaw) {
    const auto points = ReadPoints();
    const std::clock_t began = std::clock();
    const bool is_processed =
        points->points.size() >= kLeastPoints && program.update(points, lama::Pose2D(x, y, yaw), stamp);
    const double taken_ms = 1e3 * static_cast<double>(std::clock() - began) / CLOCKS_PER_SEC;
    const lama::Pose2D pose = program.pose();
    std::cout << stamp << ' ' << pose.x() << ' ' << pose.y() << ' ' << pose.rotation() << ' ' << is_processed << ' '
              << taken_ms << '\n';
  }
  std::cout.flush();
  std::_Exit(0);  // its destructors of maps take longer than the run
}
