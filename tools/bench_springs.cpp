// The elastic force of faceanim/kernels/springs.py as a C++ compiler makes it, for comparison (tools/bench_springs.py).
// Two forms: `plain`, one loop over the triangles that adds to the vertices as it goes, and `blocked`, which works on
// blocks of 128 triangles as the Numba kernel does. Same arithmetic per triangle, std::sqrt and std::pow.
#include <algorithm>
#include <cmath>

#define FORCE_INLINE __attribute__((always_inline)) inline

namespace {

struct Tables {
    const int *a, *b, *c;
    const double *edge_length, *edge_stiffness, *height, *height_stiffness, *repulsion;
    long triangles;
};

struct Law {
    double alpha, inverse_s0_squared, beta, reaction;
};

// Alpha = 0, 1, 2 and Beta = 2 are known to the compiler; -1 stands for any other number.
template <int Alpha>
FORCE_INLINE void growth(double q, const Law& law, double& secant, double& tangent) {
    if (Alpha == 0) {
        secant = tangent = 1.0;
    } else if (Alpha == 1) {
        secant = 1.0 + q;
        tangent = 1.0 + 3.0 * q;
    } else if (Alpha == 2) {
        secant = (1.0 + q) * (1.0 + q);
        tangent = (1.0 + q) * (1.0 + 5.0 * q);
    } else {
        const double p = std::pow(1.0 + q, law.alpha - 1.0);
        secant = p * (1.0 + q);
        tangent = p * (1.0 + (2.0 * law.alpha + 1.0) * q);
    }
}

template <int Alpha>
FORCE_INLINE void edge(double length, double rest, double stiffness, const Law& law, double& pull, double& tangent) {
    const double s = length - rest;
    double secant, slope;
    growth<Alpha>(s * s * law.inverse_s0_squared, law, secant, slope);
    pull = stiffness * secant * s / length;
    tangent = stiffness * slope;
}

template <int Alpha, int Beta>
FORCE_INLINE void height(double h, double rest, double stiffness, double repulsion, const Law& law, double& pull,
                   double& bound) {
    const double s = h - rest, r = rest / h;
    double secant, slope;
    growth<Alpha>(s * s * law.inverse_s0_squared, law, secant, slope);
    const double push = repulsion * (Beta == 2 ? r * r : std::pow(r, law.beta));
    pull = (push - repulsion - stiffness * secant * s) / h;
    bound = std::max(stiffness * slope + law.beta * push / h, std::abs(pull));
}

// Forces and stiffnesses of the corners of triangle i into out; coordinates and results lie Stride apart.
template <int Alpha, int Beta, int Stride>
FORCE_INLINE void triangle(const Tables& s, long i, const Law& law, const double* A, const double* B, const double* C,
                     double* __restrict out) {
    const double ux = C[0] - B[0], uy = C[Stride] - B[Stride], uz = C[2 * Stride] - B[2 * Stride];
    const double vx = A[0] - C[0], vy = A[Stride] - C[Stride], vz = A[2 * Stride] - C[2 * Stride];
    const double wx = B[0] - A[0], wy = B[Stride] - A[Stride], wz = B[2 * Stride] - A[2 * Stride];
    const double uu = ux * ux + uy * uy + uz * uz, vv = vx * vx + vy * vy + vz * vz, ww = wx * wx + wy * wy + wz * wz;
    const double nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
    const double nn = nx * nx + ny * ny + nz * nz, area = std::sqrt(nn);
    const double lu = std::sqrt(uu), lv = std::sqrt(vv), lw = std::sqrt(ww);
    const double uv = ux * vx + uy * vy + uz * vz, vw = vx * wx + vy * wy + vz * wz;
    const double m0 = -uv / uu, t1 = -uv / vv, t2 = -vw / ww, t0 = 1.0 - m0, m1 = 1.0 - t1, m2 = 1.0 - t2;
    const long n = s.triangles;
    double eu, ev, ew, ku, kv, kw, g0, g1, g2, y0, y1, y2;
    edge<Alpha>(lu, s.edge_length[i], s.edge_stiffness[i], law, eu, ku);
    edge<Alpha>(lv, s.edge_length[n + i], s.edge_stiffness[n + i], law, ev, kv);
    edge<Alpha>(lw, s.edge_length[2 * n + i], s.edge_stiffness[2 * n + i], law, ew, kw);
    height<Alpha, Beta>(area / lu, s.height[i], s.height_stiffness[i], s.repulsion[i], law, g0, y0);
    height<Alpha, Beta>(area / lv, s.height[n + i], s.height_stiffness[n + i], s.repulsion[n + i], law, g1, y1);
    height<Alpha, Beta>(area / lw, s.height[2 * n + i], s.height_stiffness[2 * n + i], s.repulsion[2 * n + i], law, g2,
                        y2);
    double r0 = law.reaction * g0, r1 = law.reaction * g1, r2 = law.reaction * g2;
    const double au = g0 * m0 + t1 * r1 - m2 * t2 * r2 - ew, av = g0 + t1 * t1 * r1 + m2 * m2 * r2 - ev - ew;
    const double bu = -g1 - m0 * m0 * r0 - t2 * t2 * r2 + ew + eu, bv = -t1 * g1 - m0 * r0 + t2 * m2 * r2 + ew;
    const double cu = t2 * g2 - t0 * m0 * r0 + m1 * r1 - eu, cv = -m2 * g2 - t0 * r0 + m1 * t1 * r1 + ev;
    y0 *= 0.5 * (1.0 + std::abs(t0) + std::abs(m0));
    y1 *= 0.5 * (1.0 + std::abs(t1) + std::abs(m1));
    y2 *= 0.5 * (1.0 + std::abs(t2) + std::abs(m2));
    r0 = 2.0 * law.reaction * std::max(r0, 0.0) * nn / (uu * uu);
    r1 = 2.0 * law.reaction * std::max(r1, 0.0) * nn / (vv * vv);
    r2 = 2.0 * law.reaction * std::max(r2, 0.0) * nn / (ww * ww);
    const double z0 = law.reaction * y0, z1 = law.reaction * y1, z2 = law.reaction * y2;
    out[0] = au * ux + av * vx;
    out[Stride] = au * uy + av * vy;
    out[2 * Stride] = au * uz + av * vz;
    out[3 * Stride] = kv + kw + y0 + std::abs(t1) * z1 + std::abs(m2) * z2 + r1 + r2;
    out[4 * Stride] = bu * ux + bv * vx;
    out[5 * Stride] = bu * uy + bv * vy;
    out[6 * Stride] = bu * uz + bv * vz;
    out[7 * Stride] = kw + ku + y1 + std::abs(t2) * z2 + std::abs(m0) * z0 + r2 + r0;
    out[8 * Stride] = cu * ux + cv * vx;
    out[9 * Stride] = cu * uy + cv * vy;
    out[10 * Stride] = cu * uz + cv * vz;
    out[11 * Stride] = ku + kv + y2 + std::abs(t0) * z0 + std::abs(m1) * z1 + r0 + r1;
}

template <int Alpha, int Beta>
void plain(const double* __restrict x, const Tables& s, const Law& law, double* __restrict out) {
    for (long i = 0; i < s.triangles; ++i) {
        double r[12];
        triangle<Alpha, Beta, 1>(s, i, law, x + 3 * s.a[i], x + 3 * s.b[i], x + 3 * s.c[i], r);
        for (int d = 0; d < 4; ++d) out[4 * s.a[i] + d] += r[d];
        for (int d = 0; d < 4; ++d) out[4 * s.b[i] + d] += r[4 + d];
        for (int d = 0; d < 4; ++d) out[4 * s.c[i] + d] += r[8 + d];
    }
}

template <int Alpha, int Beta>
void blocked(const double* __restrict x, const Tables& tables, const Law& given, double* __restrict out) {
    constexpr long block = 128;
    alignas(64) double corner[9 * block], result[12 * block];
    const Tables s = tables;
    const Law law = given;
    for (long first = 0; first < s.triangles; first += block) {
        const long count = std::min(block, s.triangles - first);
        for (long q = 0; q < count; ++q)
            for (int d = 0; d < 3; ++d) {
                corner[d * block + q] = x[3 * s.a[first + q] + d];
                corner[(3 + d) * block + q] = x[3 * s.b[first + q] + d];
                corner[(6 + d) * block + q] = x[3 * s.c[first + q] + d];
            }
#pragma omp simd
        for (long q = 0; q < count; ++q)
            triangle<Alpha, Beta, block>(s, first + q, law, corner + q, corner + 3 * block + q, corner + 6 * block + q,
                                         result + q);
        for (long q = 0; q < count; ++q)
            for (int d = 0; d < 4; ++d) {
                out[4 * s.a[first + q] + d] += result[d * block + q];
                out[4 * s.b[first + q] + d] += result[(4 + d) * block + q];
                out[4 * s.c[first + q] + d] += result[(8 + d) * block + q];
            }
    }
}

template <int Alpha, int Beta>
void run(bool in_blocks, const double* x, const Tables& s, const Law& law, double* out) {
    in_blocks ? blocked<Alpha, Beta>(x, s, law, out) : plain<Alpha, Beta>(x, s, law, out);
}

}  // namespace

extern "C" void elastic_force(int in_blocks, const double* x, const int* a, const int* b, const int* c,
                              const double* edge_length, const double* edge_stiffness, const double* height,
                              const double* height_stiffness, const double* repulsion, long triangles, long vertices,
                              double alpha, double s0, double beta, double reaction, double* out) {
    const Tables s{a, b, c, edge_length, edge_stiffness, height, height_stiffness, repulsion, triangles};
    const Law law{alpha, 1.0 / (s0 * s0), beta, reaction};
    std::fill(out, out + 4 * vertices, 0.0);
    const bool square = beta == 2.0;
    if (alpha == 0.0 && square)
        run<0, 2>(in_blocks, x, s, law, out);
    else if (alpha == 1.0 && square)
        run<1, 2>(in_blocks, x, s, law, out);
    else if (alpha == 2.0 && square)
        run<2, 2>(in_blocks, x, s, law, out);
    else if (square)
        run<-1, 2>(in_blocks, x, s, law, out);
    else
        run<-1, -1>(in_blocks, x, s, law, out);
}
