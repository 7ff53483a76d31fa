// adjoint.cl for CPUs and any views, but for rays sampled across z. Of a detector column, LANES
// successive voxels along z gather the three rays nearest to each; what they collect is shared
// between the two lines of voxels beside which the rays pass, or, where the rays cross a line,
// among as many as it takes. All is linear in the ray's number once multiplied by its advance along
// the axis, so that nothing but the ray nearest to a voxel takes a division.
//
// A work-item sums BLOCK voxels along z of WIDTH neighbouring lines over the given views. Every
// voxel, and the one beyond, has to be in front of every source.

#include "blocks.clh"

#ifndef WIDTH
#define WIDTH 16
#endif

#define SLACK 1e-2f // as in adjoint.clh

// More rows a voxel than this, and rays are treated one by one.
#define MANY 1.4f

// The rays of a detector column where they pass a plane. Ray r advances by dp + r vp along the
// axis, which is positive, moves by dq + r vq across and climbs by dz + r vz.
typedef struct {
    float t; // from the source to the plane
    float q; // of the source beside the first line of voxels
    float z; // of the source above the first voxel
    float dp, vp, dq, vq, dz, vz;
} fan;

// Adds what rays `from` to `stop` - 1 give the lines of voxels -1 to `width`.
static inline void gather_rays(
    float *sum, // of line -1
    global const float *line, // projections times length over the cube of the advance
    const fan s,
    const int from,
    const int stop,
    const int width,
    const int voxels)
{
    // Ray r is, times its advance, climbed + r climbed_row - h (dp + r vp) above voxel h and
    // across + r across_row beside line 0. Rays count from -PAD on, so that none is negative.
    const float vp = s.vp;
    const float dp = fma(-PAD, vp, s.dp);
    const float across_row = fma(s.t, s.vq, s.q * vp);
    const float across = fma(-PAD, across_row, fma(s.t, s.dq, s.q * s.dp));
    const float climbed_row = s.t * s.vz;
    const float climbed = fma(-PAD, climbed_row, s.t * s.dz);
    const float lowest_ray = from + PAD;
    const float highest_ray = stop + PAD - 1.0f;
    const float begin = fma(climbed_row, lowest_ray, climbed) / fma(vp, lowest_ray, dp) + s.z;
    const float end = fma(climbed_row, highest_ray, climbed) / fma(vp, highest_ray, dp) + s.z;
    const int first = (int)LARGER(SMALLER(begin, end) - 1.0f, 0.0f) / LANES * LANES;
    const int last = (int)SMALLER(LARGER(begin, end) + 1.0f, voxels - 1.0f);
    line -= PAD;
    for (int table = first; table <= last; table += LANES * LANES) {
        // What each run of LANES voxels needs, for LANES runs at a time: the first ray, and the
        // lines beside which the rays pass. Known ahead, it keeps no load waiting for a division.
        int bases[LANES], lows[LANES], crossings[LANES], edges[LANES];
        {
            const real h = (float)table - s.z + LANES * RAMP;
            const real end_h = h + (LANES - 1.0f);
            const real one = (dp * h - climbed) / (climbed_row - vp * h);
            const real other = (dp * end_h - climbed) / (climbed_row - vp * end_h);
            real low = SMALLER(one, other);
            real high = LARGER(one, other);
            store_whole((low < lowest_ray + 2.0f) | (high > highest_ray - 2.0f), edges);
            low = SMALLER(LARGER(low, (real)(lowest_ray - 2.0f)), (real)(highest_ray + 2.0f));
            high = SMALLER(LARGER(high, (real)(lowest_ray - 2.0f)), (real)(highest_ray + 2.0f));
            store_whole(to_whole(low), bases);
            low = SMALLER(LARGER(low - 1.5f, (real)(lowest_ray)), (real)(highest_ray));
            high = SMALLER(LARGER(high + 1.5f, (real)(lowest_ray)), (real)(highest_ray));
            const real q = (across_row * low + across) / (vp * low + dp);
            const real end_q = (across_row * high + across) / (vp * high + dp);
            const whole left = to_whole(LARGER(SMALLER(q, end_q) + 1.0f, (real)(0.0f)));
            const whole right =
                to_whole(SMALLER(LARGER(q, end_q) + 1.0f, (real)(width + 0.5f)));
            store_whole(left, lows);
            store_whole(right - left, crossings);
        }
        real h = (float)table - s.z + RAMP;
        for (int run = 0; run < LANES; ++run, h += (float)LANES) {
            const int k = table + run * LANES;
            if (k > last)
                break;
            const int base = bases[run];
            const real rise = climbed_row - vp * h;
            real r = (dp * h - climbed) / rise; // of the ray through the voxel
            if (edges[run])
                r = SMALLER(LARGER(r, (real)(lowest_ray - 2.0f)), (real)(highest_ray + 2.0f));
            const whole nearest = to_whole(r + 0.5f);
            const real m = to_real(nearest);
            const whole n = nearest - base;
            const piece w = load_piece(line + base - 1);
            // within 1.5 rows are all rays that share in the voxel
            const real advance = vp * m + dp;
            const real slope = fabs(rise);
            const real off = slope * (r - m);
            const real down = advance - slope;
            real u = LARGER(down - vp - off, (real)(0.0f)) * take(w, n);
            real v = LARGER(advance - fabs(off), (real)(0.0f)) * take(w, n + 1);
            real x = LARGER(down + vp + off, (real)(0.0f)) * take(w, n + 2);
            if (edges[run]) {
                u = WHERE((m > lowest_ray) & (m < highest_ray + 1.5f), u);
                v = WHERE((m >= lowest_ray) & (m <= highest_ray), v);
                x = WHERE((m > lowest_ray - 1.5f) & (m < highest_ray), x);
            }
            float *target = sum + lows[run] * BLOCK + k;
            const float line_number = lows[run] - 1;
            const real aside = (across_row - vp * line_number) * m + (across - dp * line_number);
            const float aside_row = across_row - vp * line_number;
            if (crossings[run] == 0) { // shares across the lines are linear in the ray, too
                const real shared = u + v + x;
                const real tilt = x - u;
                const real there = aside * shared + aside_row * tilt;
                const real both = advance * shared + vp * tilt;
                store_lanes(load_lanes(target) + (both - there), target);
                store_lanes(load_lanes(target + BLOCK) + there, target + BLOCK);
                continue;
            }
            for (int i = 0; i <= crossings[run] + 1; ++i) {
                const real beside = aside - i * advance;
                const float beside_row = aside_row - i * vp;
                const real share =
                    u * LARGER(advance - vp - fabs(beside - beside_row), (real)(0.0f)) +
                    v * LARGER(advance - fabs(beside), (real)(0.0f)) +
                    x * LARGER(advance + vp - fabs(beside + beside_row), (real)(0.0f));
                store_lanes(load_lanes(target + i * BLOCK) + share, target + i * BLOCK);
            }
        }
    }
}

// Adds what rays `from` to `stop` - 1 give the lines -1 to `width`, one ray by one.
static inline void scatter(
    float *sum, // of line -1
    global const float *line,
    const fan s,
    const int from,
    const int stop,
    const int width,
    const int voxels)
{
    for (int k = from; k < stop; ++k) {
        const float advance = fma(s.vp, (float)k, s.dp);
        const float q = fma(s.t, fma(s.vq, (float)k, s.dq) / advance, s.q);
        const float z = fma(s.t, fma(s.vz, (float)k, s.dz) / advance, s.z);
        if (!(q >= -1.0f && q < width && z >= -1.0f && z < voxels))
            continue;
        const int i = below(q), n = below(z);
        const float share = (z - n) * line[k] * advance * advance;
        const float rest = line[k] * advance * advance - share;
        float *target = sum + (i + 1) * BLOCK;
        if (n >= 0) {
            target[n] += (1.0f - (q - i)) * rest;
            target[n + BLOCK] += (q - i) * rest;
        }
        if (n + 1 < voxels) {
            target[n + 1] += (1.0f - (q - i)) * share;
            target[n + 1 + BLOCK] += (q - i) * share;
        }
    }
}

// Global size as for adjoint_columns.cl: (blocks, nx, ceil(ny / WIDTH)) for axis 0, (blocks, ny,
// ceil(nx / WIDTH)) for axis 1, rounded up at will.
kernel void adjoint_tilted(
    global float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict projections, // (count, columns + 1, pitch), padded, weighed
    const ulong projections_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int pitch, // elements of a padded line
    const int count, // views
    const int axis, // of the rays: those sampled across x, 0, or y, 1
    const int accumulate) // 1: add to the volume
{
    volume += volume_offset;
    projections += projections_offset + PAD;
    views += views_offset;
    const int z = get_global_id(0) * BLOCK;
    const int plane = get_global_id(1);
    const int side = get_global_id(2) * WIDTH;
    if (z >= nz || plane >= (axis ? ny : nx) || side >= (axis ? nx : ny))
        return;
    const int voxels = min(BLOCK, nz - z);
    const int width = min(WIDTH, (axis ? nx : ny) - side);

    float sum[(WIDTH + 2) * BLOCK]; // one column more at each side, for what goes elsewhere
    for (int k = 0; k < (WIDTH + 2) * BLOCK; ++k)
        sum[k] = 0.0f;
    for (int view = 0; view < count; ++view) {
        global const float *m = views + view * VIEW_FLOATS;
        const float t = plane - m[12 + axis];
        if (t == 0.0f)
            continue;
        const float sign = t > 0.0f ? 1.0f : -1.0f;
        // the detector columns whose rays pass the plane within one voxel of these
        float left = columns, right = -1.0f;
        for (int corner = 0; corner < 4; ++corner) {
            const float beside = corner & 1 ? side + width : side - 1;
            const float x = axis ? beside : plane;
            const float y = axis ? plane : beside;
            const float height = LIFT(m) + (corner & 2 ? z + voxels : z - 1);
            const float column = AT(m, x, y, height) / AT(m + 8, x, y, height);
            left = SMALLER(left, column);
            right = LARGER(right, column);
        }
        const int first = (int)ceil(LARGER(left - SLACK, 0.0f));
        const int last = (int)SMALLER(right + SLACK, columns - 1.0f);
        for (int c = first; c <= last; ++c) {
            fan s = {
                t,
                m[13 - axis] - side,
                m[14] - (z + LIFT(m)),
                sign * ALONG(float, m, axis, c, 0.0f),
                sign * m[21 + axis],
                sign * ALONG(float, m, 1 - axis, c, 0.0f),
                sign * m[22 - axis],
                sign * ALONG(float, m, 2, c, 0.0f),
                sign * m[23]};
            // the rows whose rays pass it within one voxel of these
            float enter = 0.0f, leave = rows - 1.0f;
            const float left_q = 1.0f + s.q, right_q = width - s.q;
            const float under = 1.0f + s.z, over = voxels - s.z;
            keep_positive(s.dp, s.vp, &enter, &leave);
            keep_positive(
                fma(t, s.dq, left_q * s.dp), fma(t, s.vq, left_q * s.vp), &enter, &leave);
            keep_positive(
                fma(-t, s.dq, right_q * s.dp), fma(-t, s.vq, right_q * s.vp), &enter, &leave);
            keep_positive(fma(t, s.dz, under * s.dp), fma(t, s.vz, under * s.vp), &enter, &leave);
            keep_positive(fma(-t, s.dz, over * s.dp), fma(-t, s.vz, over * s.vp), &enter, &leave);
            if (!(enter <= leave))
                continue;
            global const float *line = projections + ((size_t)view * (columns + 1) + c) * pitch;
            const float climb = s.vz * s.dp - s.vp * s.dz;
            const float farthest =
                LARGER(fma(s.vp, enter, s.dp), fma(s.vp, leave, s.dp));
            const int many = farthest * farthest > MANY * fabs(t * climb);
            const int end = (int)leave + 1;
            for (int from = (int)ceil(enter); from < end;) {
                const int along = main_axis(m, c, from, 0);
                const int stop = from + rows_alike(m, along, c, from, end - from);
                if (along == axis && many)
                    scatter(sum, line, s, from, stop, width, voxels);
                else if (along == axis)
                    gather_rays(sum, line, s, from, stop, width, voxels);
                from = stop;
            }
        }
    }
    for (int i = 0; i < width; ++i) {
        const size_t x = axis ? side + i : plane;
        const size_t y = axis ? plane : side + i;
        put(volume + (y * nx + x) * nz + z, sum + (i + 1) * BLOCK, voxels, accumulate);
    }
}
