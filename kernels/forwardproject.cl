// Line integrals through a volume by Joseph's method (IEEE Trans. Med. Imaging 1, 192 (1982)): a
// ray is sampled once a plane across the axis along which it advances fastest, bilinearly within
// the plane; the sum is multiplied by the length of ray between two planes. Outside the volume is
// zero, towards which the interpolation runs over one voxel.
//
// The forms for GPUs; CPUs run forwardproject_columns.cl and forwardproject_tilted.cl. Neighbouring
// work-items are neighbouring rows, which read neighbours along z. Planes where all four voxels of
// a sample exist are taken without a test. Where v is parallel to z, a work-item traces RAYS rays
// 32 rows apart, which share the place across z. Every voxel, and the one beyond, has to be in
// front of every source.
//
// Global size (rows, columns, count), of forward_axial (ceil(rows / RAYS), columns, count), rounded
// up at will, the first to whole 32.

#include "gpu.clh"

#ifndef RAYS
#define RAYS 4
#endif
// NX and NZ, or nx and nz: see gpu.clh.
#ifndef NX
#define NX nx
#define NZ nz
#endif

// Offsets in elements within a volume: 32 bits hold them up to 2^31 voxels. PLACE is that of a
// rounded number t + MAGIC less PLACE_BIAS.
#ifdef WIDE
#define OFFSET long
#define PLACE(t) ((long)(as_int(t) - (int)MAGIC_BITS))
#define PLACE_BIAS 0
#define INDEX(at) (at)
#else
#define OFFSET uint
#define PLACE(t) as_uint(t)
#define PLACE_BIAS MAGIC_BITS
#define INDEX(at) ((int)(at))
#endif

// A volume as rays along one axis p see it: sizes along p, q and l, elements from one voxel to the
// next, and where voxels begin along p and l.
typedef struct {
    global const float *volume;
    int size_p, size_q, size_l;
    OFFSET step_p, step_q, step_l;
    int from_p, from_l;
} scene;

// one sample anywhere in a plane, towards zero outside
static inline float
sample(global const float *plane, const scene s, const float q, const float l)
{
    const int iq = below(q), whole = below(l), il = whole - s.from_l;
    if (iq < -1 || iq > s.size_q - 1 || il < -1 || il > s.size_l - 1)
        return 0.0f;
    const float f = q - iq, h = l - whole;
    const float low_q = iq < 0 ? 0.0f : 1.0f - f, high_q = iq < s.size_q - 1 ? f : 0.0f;
    const float low_l = il < 0 ? 0.0f : 1.0f - h, high_l = il < s.size_l - 1 ? h : 0.0f;
    global const float *low = plane + max(iq, 0) * s.step_q;
    global const float *high = plane + min(iq + 1, s.size_q - 1) * s.step_q;
    const OFFSET l0 = max(il, 0) * s.step_l, l1 = min(il + 1, s.size_l - 1) * s.step_l;
    return low_q * (low_l * low[l0] + high_l * low[l1]) +
           high_q * (low_l * high[l0] + high_l * high[l1]);
}

// Adds to `sum` the samples of `rays` rays from (start_p, start_q, start_l), slopes as given; with
// `shared`, all have the first one's slope along q.
always_inlined void trace(
    const scene s,
    const float start_p,
    const float start_q,
    const float start_l,
    const float *slope_q,
    const float *slope_l,
    const int rays,
    const int shared,
    float *sum)
{
    // where any ray is inside the volume and one voxel around, and where all are well inside
    const int end_p = s.from_p + s.size_p - 1;
    const float under = start_l - s.from_l, over = s.from_l + s.size_l - start_l;
    float enter = INFINITY, leave = -INFINITY, in = s.from_p - start_p, out = end_p - start_p;
#pragma unroll
    for (int j = 0; j < rays; ++j) {
        float e = s.from_p - start_p, o = end_p - start_p;
        keep_inside(start_q, slope_q[j], s.size_q, &e, &o);
        keep_inside(under, slope_l[j], s.size_l, &e, &o);
        enter = SMALLER(enter, e);
        leave = LARGER(leave, o);
        keep_positive(start_q - 0.001f, slope_q[j], &in, &out);
        keep_positive(s.size_q - 1.001f - start_q, -slope_q[j], &in, &out);
        keep_positive(under - 0.001f, slope_l[j], &in, &out);
        keep_positive(over - 1.001f, -slope_l[j], &in, &out);
    }
    if (!(enter <= leave))
        return;
    const int first = max(below(enter + start_p), s.from_p);
    const int last = min(below(leave + start_p) + 1, end_p);
    // planes from..to - 1 without tests
    int from = last + 1, to = last + 1;
    if (in <= out) {
        from = min(max((int)ceil(in + start_p), first), last + 1);
        to = max(min(below(out + start_p), last) + 1, from);
    }
    // voxel (k, 0, 0) along p, q and l is `at` k steps on
    global const float *at =
        s.volume + (first - s.from_p) * (long)s.step_p - s.from_l * (long)s.step_l;
    float t = first - start_p;
#ifndef INSIDE // leaves the ways with tests out, to count instructions
#pragma unroll 1
    for (int plane = first; plane < from; ++plane, t += 1.0f, at += s.step_p)
#pragma unroll
        for (int j = 0; j < rays; ++j)
            sum[j] += sample(
                at + s.from_l * (long)s.step_l, s, fma(t, slope_q[j], start_q),
                fma(t, slope_l[j], start_l));
#endif
    for (int plane = from; plane < to; ++plane, t += 1.0f, at += s.step_p) {
        float f;
        OFFSET base;
#pragma unroll
        for (int j = 0; j < rays; ++j) {
            if (j == 0 || !shared) {
                const float q = fma(t, slope_q[j], start_q);
                const float whole = (q - 0.5f) + MAGIC;
                f = q - (whole - MAGIC);
                base = PLACE(whole) * s.step_q - PLACE_BIAS * (s.step_q + s.step_l);
            }
            const float l = fma(t, slope_l[j], start_l);
            const float whole = (l - 0.5f) + MAGIC;
            const float h = l - (whole - MAGIC);
            global const float *p = at + INDEX(PLACE(whole) * s.step_l + base);
            const float low = fma(f, p[s.step_q] - p[0], p[0]);
            const float high = fma(f, p[s.step_q + s.step_l] - p[s.step_l], p[s.step_l]);
            sum[j] = fma(h, high, fma(1.0f - h, low, sum[j]));
        }
    }
#ifndef INSIDE
#pragma unroll 1
    for (int plane = to; plane <= last; ++plane, t += 1.0f, at += s.step_p)
#pragma unroll
        for (int j = 0; j < rays; ++j)
            sum[j] += sample(
                at + s.from_l * (long)s.step_l, s, fma(t, slope_q[j], start_q),
                fma(t, slope_l[j], start_l));
#endif
}

#define ACROSS_X                                                                                   \
    {                                                                                              \
        volume, nx, ny, nz, NZ, (OFFSET)(NX) * NZ, 1, 0, LIFT(m)                                   \
    }
#define ACROSS_Y                                                                                   \
    {                                                                                              \
        volume, ny, nx, nz, (OFFSET)(NX) * NZ, NZ, 1, 0, LIFT(m)                                   \
    }
#define ACROSS_Z                                                                                   \
    {                                                                                              \
        volume, nz, nx, ny, 1, NZ, (OFFSET)(NX) * NZ, LIFT(m), 0                                   \
    }

// v is parallel to z, and no ray advances fastest along z.
kernel required_group void forward_axial(
    global float *restrict projections, // (count, rows, columns)
    const ulong projections_offset,
    global const float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int count, // views
    const float voxel_size, // [mm]
    const int accumulate) // 1: add to the projections
{
    projections += projections_offset;
    volume += volume_offset;
    const int lane = get_global_id(0) % 32;
    const int r = lane + get_global_id(0) / 32 * (32 * RAYS);
    const int c = get_global_id(1), view = get_global_id(2);
    if (r >= rows || c >= columns || view >= count)
        return;
    global const float *m = views + views_offset + view * VIEW_FLOATS;
    const float x = ALONG(float, m, 0, c, r), y = ALONG(float, m, 1, c, r);
    const int across_x = fabs(x) >= fabs(y);
    const float inverse = 1.0f / (across_x ? x : y), slope = (across_x ? y : x) * inverse;
    float slope_q[RAYS], slope_l[RAYS], sum[RAYS];
#pragma unroll
    for (int j = 0; j < RAYS; ++j) {
        slope_q[j] = slope;
        slope_l[j] = ALONG(float, m, 2, c, r + 32 * j) * inverse;
        sum[j] = 0.0f;
    }
    if (across_x) {
        const scene s = ACROSS_X;
        trace(s, m[12], m[13], m[14], slope_q, slope_l, RAYS, 1, sum);
    } else {
        const scene s = ACROSS_Y;
        trace(s, m[13], m[12], m[14], slope_q, slope_l, RAYS, 1, sum);
    }
    projections += ((size_t)view * rows + r) * columns + c;
#pragma unroll
    for (int j = 0; j < RAYS; ++j)
        if (r + 32 * j < rows) {
            const float stretch = sqrt(1.0f + slope * slope + slope_l[j] * slope_l[j]);
            global float *target = projections + 32 * j * columns;
            const float integral = sum[j] * voxel_size * stretch;
            *target = accumulate ? *target + integral : integral;
        }
}

// Any pose of the detector.
kernel required_group void forward_rays(
    global float *restrict projections, // (count, rows, columns)
    const ulong projections_offset,
    global const float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int count, // views
    const float voxel_size, // [mm]
    const int accumulate) // 1: add to the projections
{
    projections += projections_offset;
    volume += volume_offset;
    const int r = get_global_id(0), c = get_global_id(1), view = get_global_id(2);
    if (r >= rows || c >= columns || view >= count)
        return;
    global const float *m = views + views_offset + view * VIEW_FLOATS;
    const float x = ALONG(float, m, 0, c, r), y = ALONG(float, m, 1, c, r);
    const float z = ALONG(float, m, 2, c, r);
    const int axis = main_axis(m, c, r, 0);
    const float inverse = 1.0f / (axis == 0 ? x : axis == 1 ? y : z);
    const float slope_q = (axis == 0 ? y : x) * inverse, slope_l = (axis == 2 ? y : z) * inverse;
    float sum = 0.0f;
    if (axis == 0) {
        const scene s = ACROSS_X;
        trace(s, m[12], m[13], m[14], &slope_q, &slope_l, 1, 0, &sum);
    } else if (axis == 1) {
        const scene s = ACROSS_Y;
        trace(s, m[13], m[12], m[14], &slope_q, &slope_l, 1, 0, &sum);
    } else {
        const scene s = ACROSS_Z;
        trace(s, m[14], m[12], m[13], &slope_q, &slope_l, 1, 0, &sum);
    }
    const float stretch = sqrt(1.0f + slope_q * slope_q + slope_l * slope_l);
    projections += ((size_t)view * rows + r) * columns + c;
    const float integral = sum * voxel_size * stretch;
    *projections = accumulate ? *projections + integral : integral;
}
