"""The loops of the time schemes: total force, accelerated sweeps, vertex-by-vertex relaxation, leapfrog.

Notation: m mass [kg], D drag rate [1/s], h time step [s], F force [mN], k stiffness bound [mN/mm]. Every implicit
scheme solves w (x - c) = F(x) for the free vertices, w and c from `begin`: the minimum of the incremental potential
w/2 |x - c|^2 + energy(x).
"""

from __future__ import annotations

import math

import numpy as np

from faceanim.ground.jit import kernel
from faceanim.kernels.attachment import carry, find_shift, growth, tether_force, tether_pull, tie
from faceanim.kernels.contact import find, find_rigid, penalty, plane_force, plane_gap
from faceanim.kernels.muscles import aim, fibre_force, pull_of
from faceanim.kernels.skin import skin_force
from faceanim.kernels.springs import elastic_force
from faceanim.kernels.tangent import height_terms
from faceanim.kernels.triangular import solve_factored

FIRST_STEP = 0.5
"""Trial length of the first conjugate gradient step, in preconditioned directions: about one over the stiffest."""
LARGEST_STEP = 1.5
"""No step is larger, in preconditioned directions: where contact is lost the skin only seems that soft."""
FAITHFUL = 0.4
"""Share of the trial step below which its secant is not trusted with the residual."""
LONGEST_STEP = 5.0
"""No conjugate gradient step moves a vertex farther [mm]."""


@kernel
def total_force(x, scene, moment, scratch, force):
    """Write springs, tethers, muscles and known contacts at `x` (n, 3) into `force` (n, 4)."""
    elastic_force(x, scene.springs, scene.law, scratch, force)
    find_shift(x, moment.anchor, moment.shift)
    tether_force(moment.shift, scene.tethers, scene.free, force)
    fibre_force(x, moment, scene.free, force)
    plane_force(x, moment.planes, scene.colliders.stiffening, force)


@kernel
def gather(q, qd, nodes, held, moment, x, v):
    """Copy positions and velocities of `nodes` (n,) into `x`, `v` (n, 3); those held by bones go where the bones are."""
    for i in range(len(nodes)):
        j = nodes[i]
        for d in range(3):
            if held[i]:
                x[i, d] = moment.anchor[i, d]
                v[i, d] = 0.0
            else:
                x[i, d] = q[j, d]
                v[i, d] = qd[j, d]


@kernel
def scatter(x, v, nodes, m, q, qd):
    """Copy positions and velocities of the first `m` of `nodes` from `x`, `v` (n, 3) back into the body's `q`, `qd`."""
    for i in range(m):
        for d in range(3):
            q[nodes[i], d] = x[i, d]
            qd[nodes[i], d] = v[i, d]


@kernel
def put(place, q, nodes, h, q_new, qd_new):
    """Write `place` (p, 3) as the new positions of `nodes`, and the velocities that lead there from `q` in `h`."""
    for i in range(len(nodes)):
        for d in range(3):
            qd_new[nodes[i], d] = (place[i, d] - q[nodes[i], d]) / h
            q_new[nodes[i], d] = place[i, d]


@kernel
def extrapolate(x, v, h, least):
    """Move `x` (n, 3) on by h v, unless no vertex would go farther than `least` [mm]: noise must not be carried on."""
    farthest = 0.0
    for i in range(len(x)):
        farthest = max(farthest, v[i, 0] ** 2 + v[i, 1] ** 2 + v[i, 2] ** 2)
    if h * math.sqrt(farthest) > least:
        for i in range(len(x)):
            for d in range(3):
                x[i, d] += h * v[i, d]


@kernel
def second_difference(new, now, before, m, out):
    """Write new - 2 now + before of the first `m` rows into `out`, all (n, 3)."""
    for i in range(m):
        for d in range(3):
            out[i, d] = new[i, d] - 2.0 * now[i, d] + before[i, d]


@kernel
def add_once(x, lead, m):
    """Add the first `m` rows of `lead` to `x` (n, 3) and clear them."""
    for i in range(m):
        for d in range(3):
            x[i, d] += lead[i, d]
            lead[i, d] = 0.0


@kernel
def fastest(v, nodes):
    """Return the largest speed of `nodes` among the velocities `v` (n, 3)."""
    worst = 0.0
    for i in nodes:
        worst = max(worst, v[i, 0] ** 2 + v[i, 1] ** 2 + v[i, 2] ** 2)
    return math.sqrt(worst)


@kernel
def begin(q, qd, q_before, qd_before, nodes, mass, m, drag, gamma, now, before, centre, weight):
    """Write c (n, 3) and w (n,) of an implicit step for the first `m` of `nodes`.

    x' = now x + before x_before + gamma v', v' likewise: Euler (1, 0, h) or BDF2.
    """
    for i in range(m):
        j = nodes[i]
        weight[i] = mass[i] * (1.0 + drag * gamma) / (gamma * gamma)
        for d in range(3):
            x = now * q[j, d] + before * q_before[j, d]
            v = now * qd[j, d] + before * qd_before[j, d]
            centre[i, d] = x + gamma * v / (1.0 + drag * gamma)


@kernel
def finish(x, q, q_before, nodes, m, gamma, now, before, q_out, qd_out):
    """Write positions and BDF velocities of the first `m` of `nodes` into the body's `q_out`, `qd_out`."""
    for i in range(m):
        j = nodes[i]
        for d in range(3):
            qd_out[j, d] = (x[i, d] - now * q[j, d] - before * q_before[j, d]) / gamma
            q_out[j, d] = x[i, d]


@kernel
def accelerated_sweeps(x, scene, moment, scratch, weight, centre, low, high, sweeps, tolerance, reach, force, move):
    """Jacobi sweeps with Chebyshev acceleration on w (x - c) = F(x), in place.

    Each sweep divides every vertex's residual by w + k, with the k of the moment: stiffening and new contacts count
    at once. [low, high] : the eigenvalues to damp, of the matrix so scaled (at most 2)
    force : (n, 4), move : (n, 3) work   tolerance : stop when no vertex wants to go farther [mm]
    reach : of the contacts with bones and eyeballs, found anew halfway if vertices may have used up half of it by then
    Returns (sweeps made, largest residual [mN], largest wish [mm]) of the last sweep, before it moved.
    """
    middle = 0.5 * (high + low)
    half = 0.5 * (high - low)
    rho = 0.0
    residual = 0.0
    wish = 0.0
    best = np.inf
    travel = 0.0
    find_shift(x, moment.anchor, moment.shift)
    move[:] = 0.0
    for sweep in range(sweeps):
        elastic_force(x, scene.springs, scene.law, scratch, force)
        plane_force(x, moment.planes, scene.colliders.stiffening, force)
        new = 1.0 / (2.0 * middle / half - rho)
        keep = rho * new
        gain = 2.0 * new / half if rho > 0.0 else 1.0 / middle
        rho = new if rho > 0.0 else half / middle
        residual, wish = sweep_moves(x, scene, moment, weight, centre, force, keep, gain, move)
        if wish > 4.0 * best and high < 2.0:
            # `high` was too low for this state: the bound 2 never is. Start over from here.
            high = 2.0
            middle = 0.5 * (high + low)
            half = 0.5 * (high - low)
            rho = 0.0
            residual, wish = sweep_moves(x, scene, moment, weight, centre, force, 0.0, 1.0 / middle, move)
        best = min(best, wish)
        farthest = 0.0
        for i in range(scene.free):
            farthest = max(farthest, move[i, 0] ** 2 + move[i, 1] ** 2 + move[i, 2] ** 2)
            for d in range(3):
                x[i, d] += move[i, d]
                moment.shift[i, d] += move[i, d]
        travel += math.sqrt(farthest)
        if sweep == sweeps // 2 and travel > 0.5 * reach:
            find_rigid(x, scene.colliders, scene.grids, moment.pose, reach, moment.planes)
        # A single sweep must not count as a solution unless nothing moves at all: its small errors would add up.
        if wish < tolerance * tolerance and (sweep >= 3 or wish < 1e-8 * tolerance * tolerance):
            return sweep + 1, math.sqrt(residual), math.sqrt(wish)
    return sweeps, math.sqrt(residual), math.sqrt(wish)


@kernel
def sweep_moves(x, scene, moment, weight, centre, force, keep, gain, move):
    """Write the next `move` (n, 3) of a sweep: `keep` times the last one plus `gain` times the Jacobi step.

    force : (n, 4) springs and contacts; tethers and muscles are added here
    Returns the largest squared residual [mN^2] and squared Jacobi step [mm^2].
    """
    residual = 0.0
    wish = 0.0
    for i in range(scene.free):
        fx, fy, fz, k, _ = tie(moment.shift, i, scene.tethers)
        px = x[i, 0]
        py = x[i, 1]
        pz = x[i, 2]
        for e in range(moment.first[i], moment.first[i + 1]):
            ux, uy, uz, ku = pull_of(e, px, py, pz, moment)
            fx += ux
            fy += uy
            fz += uz
            k += ku
        w = weight[i]
        s = 1.0 / (w + k + force[i, 3])
        fx += force[i, 0] - w * (px - centre[i, 0])
        fy += force[i, 1] - w * (py - centre[i, 1])
        fz += force[i, 2] - w * (pz - centre[i, 2])
        r = fx * fx + fy * fy + fz * fz
        residual = max(residual, r)
        wish = max(wish, r * s * s)
        s *= gain
        move[i, 0] = keep * move[i, 0] + s * fx
        move[i, 1] = keep * move[i, 1] + s * fy
        move[i, 2] = keep * move[i, 2] + s * fz
    return residual, wish


@kernel
def residual_force(x, scene, moment, scratch, weight, centre, force, residual):
    """Write F(x) - w (x - c) of the free vertices into `residual` (m, 3); `force` (n, 4) is work, `moment.shift` known."""
    skin_force(x, moment.shift, scene.springs, scene.layer, scene.law, scratch, force)
    plane_force(x, moment.planes, scene.colliders.stiffening, force)
    for i in range(scene.free):
        fx, fy, fz = tether_pull(moment.shift, i, scene.tethers)
        px = x[i, 0]
        py = x[i, 1]
        pz = x[i, 2]
        for e in range(moment.first[i], moment.first[i + 1]):
            ux, uy, uz, _ = pull_of(e, px, py, pz, moment)
            fx += ux
            fy += uy
            fz += uz
        w = weight[i]
        residual[i, 0] = fx + force[i, 0] - w * (px - centre[i, 0])
        residual[i, 1] = fy + force[i, 1] - w * (py - centre[i, 1])
        residual[i, 2] = fz + force[i, 2] - w * (pz - centre[i, 2])


@kernel
def dot(a, b, copies):
    """Return the scalar product of `a` and `b`, each number counted as often as `copies` says, all (m, 3)."""
    one = a.reshape(a.size)
    other = b.reshape(b.size)
    often = copies.reshape(copies.size)
    total = 0.0
    for i in range(one.size):
        total += often[i] * one[i] * other[i]
    return total


@kernel
def reflect(x, half):
    """Put the ghosts of `x` (n, 3) where the mirror images of their sources are, and middle vertices on the plane."""
    for g in range(len(half.ghost)):
        i = half.ghost[g]
        j = half.source[g]
        x[i, 0] = -x[j, 0]
        x[i, 1] = x[j, 1]
        x[i, 2] = x[j, 2]
    flatten(x, half)


@kernel
def flatten(a, half):
    """Take what points off the plane of symmetry from the middle vertices' rows of `a` (n, 3)."""
    for i in half.middle:
        a[i, 0] = 0.0


@kernel
def mirror_out(nodes, m, mirror, q, qd):
    """Write the mirror images of the first `m` of `nodes` into positions and velocities `q`, `qd` (n, 3)."""
    for k in range(m):
        i = nodes[k]
        j = mirror[i]
        if i != j:
            q[j, 0] = -q[i, 0]
            qd[j, 0] = -qd[i, 0]
            for d in range(1, 3):
                q[j, d] = q[i, d]
                qd[j, d] = qd[i, d]


@kernel
def asymmetry(a, mirror):
    """Return how far the rows of `a` (n, 3) are from the mirror images of their images, the largest difference."""
    worst = 0.0
    for i in range(len(a)):
        j = mirror[i]
        worst = max(worst, abs(a[i, 0] + a[j, 0]), abs(a[i, 1] - a[j, 1]), abs(a[i, 2] - a[j, 2]))
    return worst


@kernel
def go(x, shift, step, direction, half):
    """Move the free vertices of `x` and `shift` (n, 3) by `step` times `direction` (m, 3), and the ghosts with them."""
    for i in range(len(direction)):
        for d in range(3):
            x[i, d] += step * direction[i, d]
            shift[i, d] += step * direction[i, d]
    reflect(x, half)
    reflect(shift, half)


@kernel
def longest(a):
    """Return the largest norm of a row of `a` (m, 3)."""
    worst = 0.0
    for i in range(len(a)):
        worst = max(worst, a[i, 0] ** 2 + a[i, 1] ** 2 + a[i, 2] ** 2)
    return math.sqrt(worst)


@kernel
def conjugate_gradient(x, scene, moment, scratch, weight, centre, half, factor, most, tolerance, reach, force, work):
    """Preconditioned nonlinear conjugate gradients (Polak-Ribiere, never negative) on w (x - c) = F(x), in place.

    Each iteration evaluates the forces once, a trial step ahead; the curvature met on the way gives the step's length,
    and the residual there follows by the same secant.
    half, factor : see `tables`   most : iterations   tolerance : stop when one moves no vertex farther [mm]
    force : (n, 4), work : residual, the one before, trial residual, preconditioned, direction (m, 3) and (m, 4)
    reach : of the contacts with bones and eyeballs, found anew halfway if vertices may have used up half of it by then
    Returns (iterations, largest residual [mN], longest move of the last [mm]).
    """
    residual, before, trial, z, direction, solved = work
    find_shift(x, moment.anchor, moment.shift)
    residual_force(x, scene, moment, scratch, weight, centre, force, residual)
    step = FIRST_STEP
    rz_before = 0.0
    travel = 0.0
    move = 0.0
    direction[:] = 0.0
    for k in range(most):
        flatten(residual, half)
        solve_factored(factor, residual, solved, z)
        flatten(z, half)
        rz = dot(residual, z, half.copies)
        keep = max(0.0, (rz - dot(before, z, half.copies)) / rz_before) if rz_before > 0.0 else 0.0
        for i in range(scene.free):
            for d in range(3):
                direction[i, d] = z[i, d] + keep * direction[i, d]
        rz_before = rz
        slope = dot(residual, direction, half.copies)
        far = longest(direction)
        if not far > 0.0:
            return k, 0.0, 0.0
        guess = min(step, LONGEST_STEP / far)
        go(x, moment.shift, guess, direction, half)
        residual_force(x, scene, moment, scratch, weight, centre, force, trial)
        bend = slope - dot(trial, direction, half.copies)
        step = guess * min(2.0, slope / bend) if bend > 0.5 * slope else 2.0 * guess
        step = min(step, LARGEST_STEP, LONGEST_STEP / far)
        go(x, moment.shift, step - guess, direction, half)
        share = step / guess
        for i in range(scene.free):
            for d in range(3):
                before[i, d] = residual[i, d]
                residual[i, d] += share * (trial[i, d] - residual[i, d])
        if share < FAITHFUL:
            # The trial went into something far stiffer: what was met there says little about the place reached.
            residual_force(x, scene, moment, scratch, weight, centre, force, residual)
            rz_before = 0.0
        move = step * far
        travel += move
        if move < tolerance:
            return k + 1, longest(residual), move
        if k == most // 2 and travel > 0.5 * reach:
            find_rigid(x, scene.colliders, scene.grids, moment.pose, reach, moment.planes)
            residual_force(x, scene, moment, scratch, weight, centre, force, residual)
            rz_before = 0.0
    return most, longest(residual), move


@kernel(inline=True)
def edge_pull(px, py, pz, x, j, rest, stiffness, law):
    """Return the force on a vertex at p by the structural spring to vertex `j`, its tangent and its secant stiffness."""
    dx = px - x[j, 0]
    dy = py - x[j, 1]
    dz = pz - x[j, 2]
    l = math.sqrt(dx * dx + dy * dy + dz * dz)
    s = l - rest
    secant, tangent = growth((s / law.s0) ** 2, law.alpha)
    f = -stiffness * secant * s / l
    return f * dx, f * dy, f * dz, stiffness * tangent, -f


@kernel(inline=True)
def height_push(ix, iy, iz, ax, ay, az, bx, by, bz, rest, stiffness, repulsion, law):
    """Return force on corner i over edge (a, b), the foot's place t, tangent and secant stiffness of a repulsion spring."""
    ex = bx - ax
    ey = by - ay
    ez = bz - az
    nx = ix - ax
    ny = iy - ay
    nz = iz - az
    t = (nx * ex + ny * ey + nz * ez) / (ex * ex + ey * ey + ez * ez)
    nx -= t * ex
    ny -= t * ey
    nz -= t * ez
    h = math.sqrt(nx * nx + ny * ny + nz * nz)
    first, second = height_terms(h, rest, stiffness, repulsion, law)
    f = -first / h
    return f * nx, f * ny, f * nz, t, max(second, abs(f)), -f


@kernel
def vertex_springs(i, px, py, pz, x, springs, law):
    """Return the force of the springs on vertex `i` if it were at p, their stiffness bound and secant sum."""
    total = springs.a.size
    fx = 0.0
    fy = 0.0
    fz = 0.0
    k = 0.0
    ks = 0.0
    for at in range(springs.corner_start[i], springs.corner_start[i + 1]):
        slot = springs.corner[at]
        c0 = slot // total
        q = slot - c0 * total
        if c0 == 0:
            j, l, c1, c2 = springs.b[q], springs.c[q], 1, 2
        elif c0 == 1:
            j, l, c1, c2 = springs.c[q], springs.a[q], 2, 0
        else:
            j, l, c1, c2 = springs.a[q], springs.b[q], 0, 1
        ux, uy, uz, kt, s = edge_pull(px, py, pz, x, j, springs.edge_length[c2, q], springs.edge_stiffness[c2, q], law)
        vx, vy, vz, kv, sv = edge_pull(px, py, pz, x, l, springs.edge_length[c1, q], springs.edge_stiffness[c1, q], law)
        fx += ux + vx
        fy += uy + vy
        fz += uz + vz
        k += kt + kv
        ks += s + sv
        jx, jy, jz = x[j, 0], x[j, 1], x[j, 2]
        lx, ly, lz = x[l, 0], x[l, 1], x[l, 2]
        ux, uy, uz, t, kt, s = height_push(
            px, py, pz, jx, jy, jz, lx, ly, lz,
            springs.height[c0, q], springs.height_stiffness[c0, q], springs.repulsion[c0, q], law,
        )  # fmt: skip
        fx += ux
        fy += uy
        fz += uz
        k += 0.5 * (1.0 + abs(t) + abs(1.0 - t)) * kt
        ks += s
        if law.reaction:
            ux, uy, uz, t, kt, s = height_push(
                jx, jy, jz, lx, ly, lz, px, py, pz,
                springs.height[c1, q], springs.height_stiffness[c1, q], springs.repulsion[c1, q], law,
            )  # fmt: skip
            fx -= t * ux
            fy -= t * uy
            fz -= t * uz
            k += 0.5 * abs(t) * (1.0 + abs(t) + abs(1.0 - t)) * kt
            ks += t * t * s
            ux, uy, uz, t, kt, s = height_push(
                lx, ly, lz, px, py, pz, jx, jy, jz,
                springs.height[c2, q], springs.height_stiffness[c2, q], springs.repulsion[c2, q], law,
            )  # fmt: skip
            t = 1.0 - t
            fx -= t * ux
            fy -= t * uy
            fz -= t * uz
            k += 0.5 * abs(t) * (1.0 + abs(t) + abs(1.0 - t)) * kt
            ks += t * t * s
    return fx, fy, fz, k, ks


@kernel
def vertex_force(i, px, py, pz, x, scene, moment):
    """Return the force on free vertex `i` if it were at p and the others at `x`, its stiffness bound and secant sum.

    (fx, fy, fz, k, k_secant): springs, tether and muscles; contacts not. `moment.shift` must hold the others' positions
    minus their anchors; row `i` is written. The secant sum is the paper's (Eq. 18), which
    a compressed spring makes negative.
    """
    fx, fy, fz, k, ks = vertex_springs(i, px, py, pz, x, scene.springs, scene.law)
    moment.shift[i, 0] = px - moment.anchor[i, 0]
    moment.shift[i, 1] = py - moment.anchor[i, 1]
    moment.shift[i, 2] = pz - moment.anchor[i, 2]
    ux, uy, uz, kt, s = tie(moment.shift, i, scene.tethers)
    fx += ux
    fy += uy
    fz += uz
    k += kt
    ks += s
    for e in range(moment.first[i], moment.first[i + 1]):
        ux, uy, uz, kt = pull_of(e, px, py, pz, moment)
        fx += ux
        fy += uy
        fz += uz
        k += kt
    return fx, fy, fz, k, ks


@kernel
def contact_chains(planes, head, link):
    """Chain the contacts of each vertex: `head` (n,) its first (contact, slot) as 4 c + slot, `link` (4 c,) the next."""
    head[:] = -1
    for c in range(planes.count[0]):
        for k in range(4 if planes.node[c, 1] >= 0 else 1):
            i = planes.node[c, k]
            link[4 * c + k] = head[i]
            head[i] = 4 * c + k


@kernel
def chained_contacts(i, x, planes, stiffening, head, link):
    """Return force and stiffness bound on vertex `i` by its contacts at `x`."""
    fx = 0.0
    fy = 0.0
    fz = 0.0
    k = 0.0
    at = head[i]
    while at >= 0:
        c = at // 4
        slot = at - 4 * c
        p = -plane_gap(x, planes, c)
        if p > 0.0:
            _, f, kt = penalty(p, stiffening)
            w = 1.0 if slot == 0 else -planes.weight[c, slot - 1]
            f *= w * planes.stiffness[c]
            fx += f * planes.normal[c, 0]
            fy += f * planes.normal[c, 1]
            fz += f * planes.normal[c, 2]
            k += abs(w) * planes.stiffness[c] * kt * (1.0 if planes.node[c, 1] < 0 else 2.0)
        at = link[at]
    return fx, fy, fz, k


@kernel
def sweep_in_place(x, first, last, scene, moment, weight, centre, omega, head, link):
    """One pass x_i += omega F_i / (w_i + k_i) over the vertices `first`..`last` - 1, each seeing the ones before it.

    Returns the largest squared residual [mN^2] and wish [mm^2].
    """
    find_shift(x, moment.anchor, moment.shift)
    residual = 0.0
    wish = 0.0
    for i in range(first, last):
        fx, fy, fz, k, _ = vertex_force(i, x[i, 0], x[i, 1], x[i, 2], x, scene, moment)
        cx, cy, cz, ck = chained_contacts(i, x, moment.planes, scene.colliders.stiffening, head, link)
        fx += cx - weight[i] * (x[i, 0] - centre[i, 0])
        fy += cy - weight[i] * (x[i, 1] - centre[i, 1])
        fz += cz - weight[i] * (x[i, 2] - centre[i, 2])
        r = fx * fx + fy * fy + fz * fz
        s = 1.0 / (weight[i] + k + ck)
        residual = max(residual, r)
        wish = max(wish, r * s * s)
        s *= omega
        x[i, 0] += s * fx
        x[i, 1] += s * fy
        x[i, 2] += s * fz
        for d in range(3):
            moment.shift[i, d] = x[i, d] - moment.anchor[i, d]
    return residual, wish


@kernel
def paper_step(x, v, ahead, scene, moment, mass, drag, h, secant, force, head, link):
    """Eqs. 18-19 of Zhang, Prakash & Sung with the signs repaired: own position now, the neighbours' extrapolated.

    ahead : (n, 3) work   force : (n, 4) work   secant : 1 = the paper's denominator, 0 = with tangent stiffnesses
    Returns the largest residual [mN].
    """
    for i in range(len(x)):
        for d in range(3):
            ahead[i, d] = x[i, d] + h * v[i, d]
    find_shift(ahead, moment.anchor, moment.shift)
    worst = 0.0
    for i in range(scene.free):
        fx, fy, fz, k, ks = vertex_force(i, x[i, 0], x[i, 1], x[i, 2], ahead, scene, moment)
        for d in range(3):
            moment.shift[i, d] = ahead[i, d] - moment.anchor[i, d]
        cx, cy, cz, ck = chained_contacts(i, x, moment.planes, scene.colliders.stiffening, head, link)
        force[i, 0] = fx + cx
        force[i, 1] = fy + cy
        force[i, 2] = fz + cz
        force[i, 3] = (ks if secant else k) + ck
    for i in range(scene.free):
        s = 1.0 / (mass[i] * (1.0 + h * drag) + h * h * force[i, 3])
        worst = max(worst, force[i, 0] ** 2 + force[i, 1] ** 2 + force[i, 2] ** 2)
        for d in range(3):
            v[i, d] = s * (mass[i] * v[i, d] + h * force[i, d])
            x[i, d] += h * v[i, d]
    return math.sqrt(worst)


@kernel
def semi_implicit_step(x, v, scene, moment, scratch, mass, drag, h, force):
    """The per-node implicit step with the neighbours where they are: stable for every h, slow modes lag.

    (m + h m D + h^2 k) v' = m v + h F(x). Returns the largest residual [mN].
    """
    total_force(x, scene, moment, scratch, force)
    worst = 0.0
    for i in range(scene.free):
        s = 1.0 / (mass[i] * (1.0 + h * drag) + h * h * force[i, 3])
        worst = max(worst, force[i, 0] ** 2 + force[i, 1] ** 2 + force[i, 2] ** 2)
        for d in range(3):
            v[i, d] = s * (mass[i] * v[i, d] + h * force[i, d])
            x[i, d] += h * v[i, d]
    return math.sqrt(worst)


@kernel
def largest_substep(scene, mass, drag, h, safety, force):
    """Return the largest stable leapfrog step up to `h` at the stiffness that `force` (n, 4) holds.

    With drag D integrated exactly, a mode of stiffness lambda is stable if s tanh(D s / 2) lambda < 2 D m; lambda is
    at most 2 k.
    """
    worst = 1e-300
    for i in range(scene.free):
        worst = max(worst, 2.0 * force[i, 3] / mass[i])
    high = h
    low = 0.0
    for _ in range(40):
        s = high if low == 0.0 and high == h else 0.5 * (low + high)
        damping = math.tanh(0.5 * drag * s) / drag if drag > 0.0 else 0.5 * s
        if s * damping * worst < 2.0 * safety:
            if s == h:
                return h
            low = s
        else:
            if s == h and low == 0.0:
                high = 0.999999 * h
            else:
                high = s
    return low


@kernel
def blend(a, b, share, out):
    """Write a + share (b - a) into `out`, for flat arrays."""
    for i in range(len(out)):
        out[i] = a[i] + share * (b[i] - a[i])


@kernel
def at_share(start, end, share, work, scene, moment):
    """Set muscles and bones to where they are a `share` of the step after its start."""
    blend(start.activation, end.activation, share, work.activation)
    blend(start.pose.reshape(-1), end.pose.reshape(-1), share, moment.pose.reshape(-1))
    carry(scene.tethers, moment.pose, moment.anchor)
    aim(scene.fibres, work.activation, moment.pose, moment)


@kernel
def leapfrog(x, v, held, start, end, work, scene, moment, scratch, mass, drag, h, safety, most, reach, force):
    """Kick - drift - kick with exact drag over `h`, in substeps as small as the stiffness of the moment asks for.

    start, end, work : `Drive`s at both ends of the step, between which bones and muscles go evenly
    held : (n,) vertices that go with the bones. Returns (substeps, largest force [mN]).
    """
    total_force(x, scene, moment, scratch, force)
    done = 0.0
    worst = 0.0
    for n in range(most):
        s = largest_substep(scene, mass, drag, h, safety, force)
        s = (h - done) / math.ceil((h - done) / s * (1.0 - 1e-9))
        decay = math.exp(-0.5 * drag * s)
        gain = (1.0 - decay) / drag if drag > 0.0 else 0.5 * s
        for i in range(scene.free):
            for d in range(3):
                v[i, d] = decay * v[i, d] + gain * force[i, d] / mass[i]
                x[i, d] += s * v[i, d]
        done += s
        at_share(start, end, done / h, work, scene, moment)
        for i in range(scene.free, len(x)):
            if held[i]:
                for d in range(3):
                    x[i, d] = moment.anchor[i, d]
        if n % 8 == 7:
            find(x, scene.colliders, scene.grids, moment.pose, reach, 0.5 * reach, moment.planes)
        total_force(x, scene, moment, scratch, force)
        worst = 0.0
        for i in range(scene.free):
            worst = max(worst, force[i, 0] ** 2 + force[i, 1] ** 2 + force[i, 2] ** 2)
            for d in range(3):
                v[i, d] = decay * v[i, d] + gain * force[i, d] / mass[i]
        if done >= h * (1.0 - 1e-9) or not worst < 1e300:
            return n + 1, math.sqrt(worst)
    x[:] = np.nan
    return most, math.sqrt(worst)
