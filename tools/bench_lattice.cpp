// One explicit step over the springs of a lattice as a C++ compiler makes it, for comparison (tools/bench_lattice.py):
// the same tables as faceanim/kernels/lattice.py, one plain loop over the springs and one over the nodes.
#include <cmath>

extern "C" void advance(double* x, double* v, const double* load, const int* i, const int* j, const double* stiffness,
                        const double* rest, const double* low, const double* high, double ramp, long springs,
                        const double* inverse_mass, long nodes, double dt, double drag, long count, double* force) {
    const double keep = 1.0 / (1.0 + drag * dt);
    for (long step = 0; step < count; ++step) {
        for (long k = 0; k < 3 * nodes; ++k) force[k] = load[k];
        for (long e = 0; e < springs; ++e) {
            double* p = force + 3 * i[e];
            double* q = force + 3 * j[e];
            const double *a = x + 3 * i[e], *b = x + 3 * j[e];
            const double dx = b[0] - a[0], dy = b[1] - a[1], dz = b[2] - a[2];
            const double length = std::sqrt(dx * dx + dy * dy + dz * dz + 1e-300);
            double stretch = length - rest[e];
            if (length < low[e])
                stretch += (ramp - 1.0) * (length - low[e]);
            else if (length > high[e])
                stretch += (ramp - 1.0) * (length - high[e]);
            const double f = stiffness[e] * stretch / length;
            p[0] += f * dx, p[1] += f * dy, p[2] += f * dz;
            q[0] -= f * dx, q[1] -= f * dy, q[2] -= f * dz;
        }
        for (long n = 0; n < nodes; ++n) {
            for (int d = 0; d < 3; ++d) {
                const long k = 3 * n + d;
                v[k] = keep * (v[k] + dt * inverse_mass[n] * force[k]);
                x[k] += dt * v[k];
            }
        }
    }
}
