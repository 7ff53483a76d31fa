// forwardproject.cl for CPUs and any views. Where the rays of a detector column pass a plane of
// voxels they lie along a straight line, which slowly passes from one line of voxels along z to the
// next. So LANES successive rays are sampled at once, mostly among two lines of voxels; where the
// rays cross a line, among as many as it takes.
//
// A work-item makes BLOCK rows of one column, run by run of rays that are sampled across the same
// axis. Across z, along which lines cannot be read at once, rays are traced one by one. Planes are
// as for forwardproject_columns.cl.

#include "blocks.clh"
#include "rays.clh"

// Adds what the rays (c, r + from) to (c, r + stop - 1) collect across axis p, x or y. The slopes
// are those of rays (c, r) and on in q, the other one, and in z.
static inline void add_planes(
    float *sum,
#ifdef MOMENT
    float *moment,
#endif
    const float *slopes_q,
    const float *slopes_z,
    const scene s,
    const float c,
    const float r,
    const int from,
    const int stop,
    const int p)
{
    const int q = 1 - p;
    const int across = size(s, q);
    const size_t stride_p = stride(s, p);
    const size_t stride_q = stride(s, q);
    const float start_p = s.view[12 + p];
    const float start_q = s.view[12 + q];
    const int lift = origin(s, 2);
    const float start_z = s.view[14];
    const float over_first = start_z - lift; // of the source over the volume's plane 0
    // Ray (c, r + k) advances by dp + k vp along p, and so on; turned round if that is negative.
    const float sign = ALONG(float, s.view, p, c, r + from) > 0.0f ? 1.0f : -1.0f;
    const float dp = sign * ALONG(float, s.view, p, c, r), vp = sign * s.view[21 + p];
    const float dq = sign * ALONG(float, s.view, q, c, r), vq = sign * s.view[21 + q];
    const float dz = sign * ALONG(float, s.view, 2, c, r), vz = sign * s.view[23];
    const float nearest = SMALLER(fma(vp, (float)from, dp), fma(vp, stop - 1.0f, dp));
    // the slope in z changes from row to row by this over the square of the advance
    const float climb = vz * dp - vp * dz;
    const int end_plane = min(s.to_plane, size(s, p));
    for (int plane = s.from_plane; plane < end_plane; ++plane) {
        const float t = plane - start_p;
        // the rows whose rays pass within a voxel of the volume
        float enter = from, leave = stop - 1.0f;
        const float left = start_q + 1.0f, right = across - start_q;
        const float below_z = over_first + 1.0f, above_z = s.nz - over_first;
        keep_positive(fma(t, dq, left * dp), fma(t, vq, left * vp), &enter, &leave);
        keep_positive(fma(-t, dq, right * dp), fma(-t, vq, right * vp), &enter, &leave);
        keep_positive(fma(t, dz, below_z * dp), fma(t, vz, below_z * vp), &enter, &leave);
        keep_positive(fma(-t, dz, above_z * dp), fma(-t, vz, above_z * vp), &enter, &leave);
        if (!(enter <= leave))
            continue;
        const int first = (int)ceil(enter);
        const int last = (int)leave;
        global const float *lines = s.volume + plane * stride_p;
        if (s.nz < PIECE ||
            fabs(t * climb) * (LANES - 1) > (SPAN - 2.0f) * nearest * nearest) {
            for (int k = first; k <= last; ++k) {
                const float at_q = fma(t, slopes_q[k], start_q);
                const float at_z = fma(t, slopes_z[k], start_z);
                const int low = below(at_q);
                float value = 0.0f;
                if (low >= 0 && low < across)
                    value = (1.0f - (at_q - low)) * tap(lines + low * stride_q, s.nz, lift, at_z);
                if (low >= -1 && low + 1 < across)
                    value += (at_q - low) * tap(lines + (low + 1) * stride_q, s.nz, lift, at_z);
                sum[k] += value;
#ifdef MOMENT
                moment[k] += value / t;
#endif
            }
            continue;
        }
        for (int table = first / LANES * LANES; table <= last; table += LANES * LANES) {
            // Where in the plane each run of LANES rays lies, for LANES runs at a time: known
            // ahead, it keeps no load waiting.
            int lows[LANES], bases[LANES], kinds[LANES];
            {
                const real begin = table + LANES * RAMP;
                const real row = LARGER(begin, (real)(first));
                const real end_row = SMALLER(begin + (LANES - 1.0f), (real)(last));
                const real scale = t / (vp * row + dp);
                const real end_scale = t / (vp * end_row + dp);
                const real q = (vq * row + dq) * scale + (start_q + 1.0f);
                const real end_q = (vq * end_row + dq) * end_scale + (start_q + 1.0f);
                const real z = (vz * row + dz) * scale + (over_first + PAD);
                const real end_z = (vz * end_row + dz) * end_scale + (over_first + PAD);
                const real left = SMALLER(q, end_q), right = LARGER(q, end_q);
                const real bottom = SMALLER(z, end_z), top = LARGER(z, end_z);
                const whole low = to_whole(LARGER(left, (real)(0.0f))) - 1;
                // none, and not -1, where rounding takes the rays past the last line's neighbour
                const whole beyond_low =
                    to_whole(SMALLER(right, (real)(across + 0.5f))) - (low + 1);
                const whole crossings = LARGER(beyond_low, (whole)(0));
                const whole base = to_whole(bottom) - PAD;
                const whole ragged = (left < 1.0f) | (right >= (float)across) |
                                     (bottom < (float)PAD) | (top >= s.nz - 1.0f + PAD) |
                                     ((crossings > 0) & (base > s.nz - PIECE));
                store_whole(low, lows);
                store_whole(ragged ? base : SMALLER(base, (whole)(s.nz - PIECE)), bases);
                store_whole(ragged ? -1 - crossings : crossings, kinds);
            }
            for (int run = 0; run < LANES; ++run) {
                const int k = table + run * LANES;
                if (k > last)
                    break;
                const int base = bases[run];
                const real q = t * load_lanes(slopes_q + k) + (start_q - lows[run]);
                const real beyond = t * load_lanes(slopes_z + k) + (start_z - (lift + base));
                global const float *line = lines + lows[run] * (long)stride_q;
                real value;
                if (kinds[run] >= 0) {
                    const whole n = to_whole(beyond);
                    const real along = beyond - to_real(n);
                    global const float *next = line + stride_q + base;
                    value = between(load_piece(line + base), n, along);
                    const real high = between(load_piece(next), n, along);
                    if (kinds[run] == 0)
                        value += q * (high - value);
                    else {
                        value = LARGER(1.0f - q, (real)(0.0f)) * value + hats(q - 1.0f) * high;
                        for (int i = 2; i <= kinds[run] + 1; ++i) {
                            // From one element before, now and then: clang makes permutations
                            // only where it computes the subscripts, so that they have to change
                            // from line to line. There are elements before line 2.
                            next += stride_q;
                            const int before = i & 1 ? 0 : 1;
                            const real place = beyond + (float)before;
                            const whole at = to_whole(place);
                            value += hats(q - (float)i) * between(load_piece(next - before), at,
                                                                  place - to_real(at));
                        }
                    }
                } else { // beyond the first or last line, or its ends
                    const int within = clamp(base, 0, s.nz - PIECE);
                    const int end = min(-kinds[run], across - 1 - lows[run]);
                    value = 0.0f;
                    for (int i = max(0, -lows[run]); i <= end; ++i) {
                        const real place = beyond + (float)(i + PIECE);
                        const whole at = to_whole(place);
                        value += hats(q - (float)i) *
                                 between_zeros(load_piece(line + i * stride_q + within),
                                               at + (base - within - i - PIECE),
                                               place - to_real(at));
                    }
                }
                if (k < first || k + LANES > last + 1) { // rays that do not meet this plane
                    const whole row = k + COUNT;
                    value = WHERE((row >= first) & (row <= last), value);
                }
                store_lanes(load_lanes(sum + k) + value, sum + k);
#ifdef MOMENT
                store_lanes(load_lanes(moment + k) + value / t, moment + k);
#endif
            }
        }
    }
}

// Global size (blocks, columns, count), rounded up at will.
kernel void forward_tilted(
    global float *restrict projections, // (count, columns + 1, pitch), padded
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
    const int pitch, // elements of a padded line
    const int count, // views
    const int from_plane, // planes across x, y or z; from_plane > 0: add to the projections
    const int to_plane,
    const float voxel_size) // [mm]
{
    projections += projections_offset + PAD;
    const int r = get_global_id(0) * BLOCK;
    const int c = get_global_id(1);
    const int view = get_global_id(2);
    if (r >= rows || c >= columns || view >= count)
        return;
    const int pixels = min(BLOCK, rows - r);
    const scene s = {
        volume + volume_offset,
        nx,
        ny,
        nz,
        views + views_offset + view * VIEW_FLOATS,
        from_plane,
        to_plane};
    float sum[BLOCK], slopes_q[BLOCK], slopes_z[BLOCK];
    for (int k = 0; k < BLOCK; ++k)
        sum[k] = 0.0f;
#ifdef MOMENT
    float moment[BLOCK], advances[BLOCK];
    for (int k = 0; k < BLOCK; ++k)
        moment[k] = 0.0f;
#endif
    for (int from = 0; from < pixels;) {
        const int axis = main_axis(s.view, c, r + from, 0);
        const int stop = from + rows_alike(s.view, axis, c, r + from, pixels - from);
        if (axis < 2) {
            for (int k = from / LANES * LANES; k < stop; k += LANES) {
                // lanes of other rows take the end's place
                const real row = clamp(r + k + RAMP, (real)(r + from), (real)(r + stop - 1));
                const real x = ALONG(real, s.view, 0, c, row);
                const real y = ALONG(real, s.view, 1, c, row);
                const real inverse = 1.0f / (axis ? y : x);
                store_lanes((axis ? x : y) * inverse, slopes_q + k);
#ifdef MOMENT
                store_lanes(axis ? y : x, advances + k);
#endif
                store_lanes(ALONG(real, s.view, 2, c, row) * inverse, slopes_z + k);
            }
#ifdef MOMENT
            add_planes(sum, moment, slopes_q, slopes_z, s, c, r, from, stop, axis);
#else
            add_planes(sum, slopes_q, slopes_z, s, c, r, from, stop, axis);
#endif
            for (int k = from / LANES * LANES; k < stop; k += LANES) {
                const real a = load_lanes(slopes_q + k);
                const real b = load_lanes(slopes_z + k);
                const real stretched = voxel_size * sqrt(1.0f + a * a + b * b);
                const whole row = k + COUNT;
                const whole mine = (row >= from) & (row < stop);
                const real sampled = load_lanes(sum + k);
                store_lanes(mine ? sampled * stretched : sampled, sum + k);
#ifdef MOMENT
                const real over_depth = load_lanes(moment + k);
                store_lanes(
                    mine ? over_depth * stretched * load_lanes(advances + k) : over_depth,
                    moment + k);
#endif
            }
        } else
            for (int k = from; k < stop; ++k) {
                const sums integral =
                    voxel_size * stretch(s, c, r + k, 2) * trace(s, c, r + k, 2);
                sum[k] = INTEGRAL(integral);
#ifdef MOMENT
                moment[k] = integral.s1;
#endif
            }
        from = stop;
    }
    global float *target = projections + ((size_t)view * (columns + 1) + c) * pitch + r;
    put(target, sum, pixels, from_plane > 0);
#ifdef MOMENT
    put(target + (size_t)count * (columns + 1) * pitch, moment, pixels, from_plane > 0);
#endif
}
