#define WP_NO_BFLOAT16

#define WP_TILE_BLOCK_DIM 1
#define WP_NO_CRT
#include "builtin.h"
#include "deterministic.h"

#define builtin_tid1d() wp::linear_tid<wp_linear_tid>(task_index, dim)
#define builtin_tid2d(x, y) wp::tid(x, y, task_index, dim)
#define builtin_tid3d(x, y, z) wp::tid(x, y, z, task_index, dim)
#define builtin_tid4d(x, y, z, w) wp::tid(x, y, z, w, task_index, dim)

#define builtin_block_dim() wp::block_dim()


// avoid namespacing of float type for casting to float type, this is to avoid wp::float(x), which is not valid in C++
#define float(x) cast_float(x)
#define adj_float(x, adj_x, adj_ret) adj_cast_float(x, adj_x, adj_ret)

#define int(x) cast_int(x)
#define adj_int(x, adj_x, adj_ret) adj_cast_int(x, adj_x, adj_ret)


// /work/main/warpslam/kernels/rays.py:282
static wp::float32 fraction_0(
    wp::int32 var_k,
    wp::int32 var_count,
    wp::int32 var_jitter,
    wp::uint32 var_state)
{
    //---------
    // primal vars
    wp::float32 var_0;
    const wp::int32 var_1 = 1;
    wp::int32 var_2;
    wp::float32 var_3;
    wp::float32 var_4;
    const wp::int32 var_5 = 0;
    bool var_6;
    const wp::float32 var_7 = 1.0;
    const wp::int32 var_8 = 1;
    wp::int32 var_9;
    wp::float32 var_10;
    wp::float32 var_11;
    const wp::float32 var_12 = 0.5;
    wp::float32 var_13;
    wp::float32 var_14;
    const wp::float32 var_15 = 0.0;
    wp::float32 var_16;
    const wp::float32 var_17 = 0.5;
    wp::float32 var_18;
    wp::float32 var_19;
    const wp::float32 var_20 = 1.0;
    wp::float32 var_21;
    wp::int32 var_22;
    wp::uint32 var_23;
    wp::float32 var_24;
    wp::float32 var_25;
    wp::float32 var_26;
    wp::float32 var_27;
    wp::float32 var_28;
    //---------
    // forward
    // def fraction(k: int, count: int, jitter: int, state: wp.uint32) -> float:              <L 283>
    // s = float(k) / float(count - 1)                                                        <L 285>
    var_0 = wp::float(var_k);
    var_2 = wp::sub(var_count, var_1);
    var_3 = wp::float(var_2);
    var_4 = wp::div(var_0, var_3);
    // if jitter != 0:                                                                        <L 286>
    var_6 = (var_jitter != var_5);
    if (var_6) {
        // step = 1.0 / float(count - 1)                                                      <L 287>
        var_9 = wp::sub(var_count, var_8);
        var_10 = wp::float(var_9);
        var_11 = wp::div(var_7, var_10);
        // low = wp.max(s - 0.5 * step, 0.0)                                                  <L 288>
        var_13 = wp::mul(var_12, var_11);
        var_14 = wp::sub(var_4, var_13);
        var_16 = wp::max(var_14, var_15);
        // high = wp.min(s + 0.5 * step, 1.0)                                                 <L 289>
        var_18 = wp::mul(var_17, var_11);
        var_19 = wp::add(var_4, var_18);
        var_21 = wp::min(var_19, var_20);
        // random = wp.rand_init(int(state), k)                                               <L 290>
        var_22 = wp::int(var_state);
        var_23 = wp::rand_init(var_22, var_k);
        // s = low + (high - low) * wp.randf(random)                                          <L 291>
        var_24 = wp::sub(var_21, var_16);
        var_25 = wp::randf(var_23);
        var_26 = wp::mul(var_24, var_25);
        var_27 = wp::add(var_16, var_26);
    }
    var_28 = wp::where(var_6, var_27, var_4);
    // return s                                                                               <L 292>
    return var_28;
}


// /work/main/warpslam/kernels/rays.py:295
static wp::float32 stratum_0(
    wp::int32 var_k,
    wp::int32 var_count,
    wp::float32 var_near,
    wp::float32 var_far,
    wp::int32 var_jitter,
    wp::uint32 var_state)
{
    //---------
    // primal vars
    wp::float32 var_0;
    const wp::float32 var_1 = 1.0;
    wp::float32 var_2;
    wp::float32 var_3;
    wp::float32 var_4;
    wp::float32 var_5;
    //---------
    // forward
    // def stratum(k: int, count: int, near: float, far: float, jitter: int, state: wp.uint32) -> float:       <L 296>
    // s = fraction(k, count, jitter, state)                                                  <L 297>
    var_0 = fraction_0(var_k, var_count, var_jitter, var_state);
    // return near * (1.0 - s) + far * s                                                      <L 298>
    var_2 = wp::sub(var_1, var_0);
    var_3 = wp::mul(var_near, var_2);
    var_4 = wp::mul(var_far, var_0);
    var_5 = wp::add(var_3, var_4);
    return var_5;
}


// /work/main/warpslam/kernels/rays.py:301
static wp::float32 surface_sample_0(
    wp::int32 var_k,
    wp::int32 var_count,
    wp::float32 var_depth,
    wp::float32 var_max_depth,
    wp::int32 var_jitter,
    wp::uint32 var_state)
{
    //---------
    // primal vars
    const wp::int32 var_0 = 1000003;
    wp::uint32 var_1;
    wp::uint32 var_2;
    wp::float32 var_3;
    const wp::float32 var_4 = 0.0;
    bool var_5;
    const wp::float32 var_6 = 0.95;
    wp::float32 var_7;
    const wp::float32 var_8 = 1.0;
    wp::float32 var_9;
    wp::float32 var_10;
    const wp::float32 var_11 = 1.05;
    wp::float32 var_12;
    wp::float32 var_13;
    wp::float32 var_14;
    const wp::float32 var_15 = 0.001;
    const wp::float32 var_16 = 1.0;
    wp::float32 var_17;
    wp::float32 var_18;
    wp::float32 var_19;
    wp::float32 var_20;
    //---------
    // forward
    // def surface_sample(k: int, count: int, depth: float, max_depth: float, jitter: int, state: wp.uint32) -> float:       <L 302>
    // s = fraction(k, count, jitter, state + wp.uint32(1000003))                             <L 304>
    var_1 = wp::uint32(var_0);
    var_2 = wp::add(var_state, var_1);
    var_3 = fraction_0(var_k, var_count, var_jitter, var_2);
    // if depth > 0.0:                                                                        <L 305>
    var_5 = (var_depth > var_4);
    if (var_5) {
        // return 0.95 * depth * (1.0 - s) + 1.05 * depth * s                                 <L 306>
        var_7 = wp::mul(var_6, var_depth);
        var_9 = wp::sub(var_8, var_3);
        var_10 = wp::mul(var_7, var_9);
        var_12 = wp::mul(var_11, var_depth);
        var_13 = wp::mul(var_12, var_3);
        var_14 = wp::add(var_10, var_13);
        return var_14;
    }
    // return 0.001 * (1.0 - s) + max_depth * s                                               <L 307>
    var_17 = wp::sub(var_16, var_3);
    var_18 = wp::mul(var_15, var_17);
    var_19 = wp::mul(var_max_depth, var_3);
    var_20 = wp::add(var_18, var_19);
    return var_20;
}


// /work/main/warpslam/kernels/rays.py:310
static void place_ray_0(
    wp::int32 var_tid,
    wp::int32 var_count,
    wp::int32 var_surface_count,
    wp::float32 var_near,
    wp::float32 var_far,
    wp::float32 var_depth,
    wp::float32 var_max_depth,
    wp::int32 var_jitter,
    wp::uint32 var_state,
    wp::array_t<wp::float32> var_z)
{
    //---------
    // primal vars
    wp::int32 var_0;
    const wp::int32 var_1 = 0;
    wp::int32 var_2;
    const wp::int32 var_3 = 0;
    wp::int32 var_4;
    const wp::int32 var_5 = 0;
    wp::float32 var_6;
    const wp::float32 var_7 = 0.0;
    wp::float32 var_8;
    const wp::int32 var_9 = 0;
    bool var_10;
    const wp::int32 var_11 = 0;
    wp::float32 var_12;
    wp::float32 var_13;
    wp::range_t var_14;
    wp::int32 var_15;
    bool var_16;
    bool var_17;
    bool var_18;
    bool var_19;
    bool var_20;
    wp::int32 var_21;
    wp::int32 var_22;
    const wp::int32 var_23 = 1;
    wp::int32 var_24;
    bool var_25;
    wp::float32 var_26;
    wp::float32 var_27;
    wp::int32 var_28;
    wp::int32 var_29;
    const wp::int32 var_30 = 1;
    wp::int32 var_31;
    bool var_32;
    wp::float32 var_33;
    wp::float32 var_34;
    wp::int32 var_35;
    wp::int32 var_36;
    wp::float32 var_37;
    wp::float32 var_38;
    //---------
    // forward
    // def place_ray(                                                                         <L 311>
    // total = count + surface_count                                                          <L 324>
    var_0 = wp::add(var_count, var_surface_count);
    // a = int(0)                                                                             <L 325>
    var_2 = wp::int(var_1);
    // b = int(0)                                                                             <L 326>
    var_4 = wp::int(var_3);
    // za = stratum(0, count, near, far, jitter, state)                                       <L 327>
    var_6 = stratum_0(var_5, var_count, var_near, var_far, var_jitter, var_state);
    // zb = float(0.0)                                                                        <L 328>
    var_8 = wp::float(var_7);
    // if surface_count > 0:                                                                  <L 329>
    var_10 = (var_surface_count > var_9);
    if (var_10) {
        // zb = surface_sample(0, surface_count, depth, max_depth, jitter, state)             <L 330>
        var_12 = surface_sample_0(var_11, var_surface_count, var_depth, var_max_depth, var_jitter, var_state);
    }
    var_13 = wp::where(var_10, var_12, var_8);
    // for n in range(total):                                                                 <L 331>
    var_14 = wp::range(var_0);
    start_for_0:;
        if (iter_cmp(var_14) == 0) goto end_for_0;
        var_15 = wp::iter_next(var_14);
        // take_a = a < count                                                                 <L 332>
        var_16 = (var_2 < var_count);
        // if take_a and b < surface_count:                                                   <L 333>
        var_17 = var_16;
        if (var_17) {
            var_18 = (var_4 < var_surface_count);
            var_17 = var_17 && var_18;
        }
        if (var_17) {
            // take_a = za <= zb                                                              <L 334>
            var_19 = (var_6 <= var_13);
        }
        var_20 = wp::where(var_17, var_19, var_16);
        // if take_a:                                                                         <L 335>
        if (var_20) {
            // z[tid * total + n] = za                                                        <L 336>
            var_21 = wp::mul(var_tid, var_0);
            var_22 = wp::add(var_21, var_15);
            wp::array_store(var_z, var_22, var_6);
            // a += 1                                                                         <L 337>
            var_24 = wp::add(var_2, var_23);
            // if a < count:                                                                  <L 338>
            var_25 = (var_24 < var_count);
            if (var_25) {
                // za = stratum(a, count, near, far, jitter, state)                           <L 339>
                var_26 = stratum_0(var_24, var_count, var_near, var_far, var_jitter, var_state);
            }
            var_27 = wp::where(var_25, var_26, var_6);
        }
        if (!var_20) {
            // z[tid * total + n] = zb                                                        <L 341>
            var_28 = wp::mul(var_tid, var_0);
            var_29 = wp::add(var_28, var_15);
            wp::array_store(var_z, var_29, var_13);
            // b += 1                                                                         <L 342>
            var_31 = wp::add(var_4, var_30);
            // if b < surface_count:                                                          <L 343>
            var_32 = (var_31 < var_surface_count);
            if (var_32) {
                // zb = surface_sample(b, surface_count, depth, max_depth, jitter, state)       <L 344>
                var_33 = surface_sample_0(var_31, var_surface_count, var_depth, var_max_depth, var_jitter, var_state);
            }
            var_34 = wp::where(var_32, var_33, var_13);
        }
        var_35 = wp::where(var_20, var_24, var_2);
        var_36 = wp::where(var_20, var_4, var_31);
        var_37 = wp::where(var_20, var_27, var_6);
        var_38 = wp::where(var_20, var_13, var_34);
        wp::assign(var_2, var_35);
        wp::assign(var_4, var_36);
        wp::assign(var_6, var_37);
        wp::assign(var_13, var_38);
        goto start_for_0;
    end_for_0:;
}


// /work/main/warpslam/kernels/rays.py:34
static wp::vec_t<3, wp::float32> pixel_direction_0(
    wp::int32 var_u,
    wp::int32 var_v,
    wp::vec_t<2, wp::float32> var_focal,
    wp::vec_t<2, wp::float32> var_center)
{
    //---------
    // primal vars
    wp::float32 var_0;
    const wp::int32 var_1 = 0;
    wp::float32 var_2;
    wp::float32 var_3;
    const wp::int32 var_4 = 0;
    wp::float32 var_5;
    wp::float32 var_6;
    wp::float32 var_7;
    const wp::int32 var_8 = 1;
    wp::float32 var_9;
    wp::float32 var_10;
    const wp::int32 var_11 = 1;
    wp::float32 var_12;
    wp::float32 var_13;
    const wp::float32 var_14 = 1.0;
    wp::vec_t<3, wp::float32> var_15;
    //---------
    // forward
    // def pixel_direction(u: int, v: int, focal: wp.vec2, center: wp.vec2) -> wp.vec3:       <L 35>
    // return wp.vec3((float(u) - center[0]) / focal[0], (float(v) - center[1]) / focal[1], 1.0)       <L 36>
    var_0 = wp::float(var_u);
    var_2 = wp::extract(var_center, var_1);
    var_3 = wp::sub(var_0, var_2);
    var_5 = wp::extract(var_focal, var_4);
    var_6 = wp::div(var_3, var_5);
    var_7 = wp::float(var_v);
    var_9 = wp::extract(var_center, var_8);
    var_10 = wp::sub(var_7, var_9);
    var_12 = wp::extract(var_focal, var_11);
    var_13 = wp::div(var_10, var_12);
    var_15 = wp::vec_t<3, wp::float32>(var_6, var_13, var_14);
    return var_15;
}


// /work/main/warpslam/kernels/rays.py:39
static wp::vec_t<2, wp::int32> cell_pixel_0(
    wp::int32 var_cell,
    wp::vec_t<2, wp::int32> var_cells,
    wp::int32 var_width,
    wp::int32 var_height,
    wp::float32 var_x,
    wp::float32 var_y)
{
    //---------
    // primal vars
    const wp::int32 var_0 = 0;
    wp::int32 var_1;
    wp::int32 var_2;
    wp::float32 var_3;
    wp::float32 var_4;
    wp::float32 var_5;
    wp::float32 var_6;
    const wp::int32 var_7 = 0;
    wp::int32 var_8;
    wp::float32 var_9;
    wp::float32 var_10;
    const wp::int32 var_11 = 0;
    wp::int32 var_12;
    wp::int32 var_13;
    wp::float32 var_14;
    wp::float32 var_15;
    wp::float32 var_16;
    wp::float32 var_17;
    const wp::int32 var_18 = 1;
    wp::int32 var_19;
    wp::float32 var_20;
    wp::float32 var_21;
    wp::int32 var_22;
    const wp::int32 var_23 = 1;
    wp::int32 var_24;
    wp::int32 var_25;
    wp::int32 var_26;
    const wp::int32 var_27 = 1;
    wp::int32 var_28;
    wp::int32 var_29;
    wp::vec_t<2, wp::int32> var_30;
    //---------
    // forward
    // def cell_pixel(cell: int, cells: wp.vec2i, width: int, height: int, x: float, y: float) -> wp.vec2i:       <L 40>
    // u = (float(cell % cells[0]) + x) * float(width) / float(cells[0])                      <L 42>
    var_1 = wp::extract(var_cells, var_0);
    var_2 = wp::mod(var_cell, var_1);
    var_3 = wp::float(var_2);
    var_4 = wp::add(var_3, var_x);
    var_5 = wp::float(var_width);
    var_6 = wp::mul(var_4, var_5);
    var_8 = wp::extract(var_cells, var_7);
    var_9 = wp::float(var_8);
    var_10 = wp::div(var_6, var_9);
    // v = (float(cell // cells[0]) + y) * float(height) / float(cells[1])                    <L 43>
    var_12 = wp::extract(var_cells, var_11);
    var_13 = wp::floordiv(var_cell, var_12);
    var_14 = wp::float(var_13);
    var_15 = wp::add(var_14, var_y);
    var_16 = wp::float(var_height);
    var_17 = wp::mul(var_15, var_16);
    var_19 = wp::extract(var_cells, var_18);
    var_20 = wp::float(var_19);
    var_21 = wp::div(var_17, var_20);
    // return wp.vec2i(wp.min(int(u), width - 1), wp.min(int(v), height - 1))                 <L 44>
    var_22 = wp::int(var_10);
    var_24 = wp::sub(var_width, var_23);
    var_25 = wp::min(var_22, var_24);
    var_26 = wp::int(var_21);
    var_28 = wp::sub(var_height, var_27);
    var_29 = wp::min(var_26, var_28);
    var_30 = wp::vec_t<2, wp::int32>(var_25, var_29);
    return var_30;
}


// /work/main/warpslam/kernels/rays.py:24
static wp::mat_t<3, 3, wp::float32> rotation_from_quaternion_0(
    wp::float32 var_w,
    wp::float32 var_x,
    wp::float32 var_y,
    wp::float32 var_z)
{
    //---------
    // primal vars
    const wp::float32 var_0 = 2.0;
    wp::float32 var_1;
    wp::float32 var_2;
    wp::float32 var_3;
    wp::float32 var_4;
    wp::float32 var_5;
    wp::float32 var_6;
    wp::float32 var_7;
    wp::float32 var_8;
    const wp::float32 var_9 = 1.0;
    wp::float32 var_10;
    wp::float32 var_11;
    wp::float32 var_12;
    wp::float32 var_13;
    wp::float32 var_14;
    wp::float32 var_15;
    wp::float32 var_16;
    wp::float32 var_17;
    wp::float32 var_18;
    wp::float32 var_19;
    wp::float32 var_20;
    wp::float32 var_21;
    wp::float32 var_22;
    wp::float32 var_23;
    wp::float32 var_24;
    wp::float32 var_25;
    wp::float32 var_26;
    const wp::float32 var_27 = 1.0;
    wp::float32 var_28;
    wp::float32 var_29;
    wp::float32 var_30;
    wp::float32 var_31;
    wp::float32 var_32;
    wp::float32 var_33;
    wp::float32 var_34;
    wp::float32 var_35;
    wp::float32 var_36;
    wp::float32 var_37;
    wp::float32 var_38;
    wp::float32 var_39;
    wp::float32 var_40;
    wp::float32 var_41;
    wp::float32 var_42;
    wp::float32 var_43;
    wp::float32 var_44;
    const wp::float32 var_45 = 1.0;
    wp::float32 var_46;
    wp::float32 var_47;
    wp::float32 var_48;
    wp::float32 var_49;
    wp::float32 var_50;
    wp::mat_t<3, 3, wp::float32> var_51;
    //---------
    // forward
    // def rotation_from_quaternion(w: float, x: float, y: float, z: float) -> wp.mat33:       <L 25>
    // s = 2.0 / (w * w + x * x + y * y + z * z)                                              <L 26>
    var_1 = wp::mul(var_w, var_w);
    var_2 = wp::mul(var_x, var_x);
    var_3 = wp::add(var_1, var_2);
    var_4 = wp::mul(var_y, var_y);
    var_5 = wp::add(var_3, var_4);
    var_6 = wp::mul(var_z, var_z);
    var_7 = wp::add(var_5, var_6);
    var_8 = wp::div(var_0, var_7);
    // return wp.mat33(                                                                       <L 27>
    // 1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),                   <L 28>
    var_10 = wp::mul(var_y, var_y);
    var_11 = wp::mul(var_z, var_z);
    var_12 = wp::add(var_10, var_11);
    var_13 = wp::mul(var_8, var_12);
    var_14 = wp::sub(var_9, var_13);
    var_15 = wp::mul(var_x, var_y);
    var_16 = wp::mul(var_z, var_w);
    var_17 = wp::sub(var_15, var_16);
    var_18 = wp::mul(var_8, var_17);
    var_19 = wp::mul(var_x, var_z);
    var_20 = wp::mul(var_y, var_w);
    var_21 = wp::add(var_19, var_20);
    var_22 = wp::mul(var_8, var_21);
    // s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w),                   <L 29>
    var_23 = wp::mul(var_x, var_y);
    var_24 = wp::mul(var_z, var_w);
    var_25 = wp::add(var_23, var_24);
    var_26 = wp::mul(var_8, var_25);
    var_28 = wp::mul(var_x, var_x);
    var_29 = wp::mul(var_z, var_z);
    var_30 = wp::add(var_28, var_29);
    var_31 = wp::mul(var_8, var_30);
    var_32 = wp::sub(var_27, var_31);
    var_33 = wp::mul(var_y, var_z);
    var_34 = wp::mul(var_x, var_w);
    var_35 = wp::sub(var_33, var_34);
    var_36 = wp::mul(var_8, var_35);
    // s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y),                   <L 30>
    var_37 = wp::mul(var_x, var_z);
    var_38 = wp::mul(var_y, var_w);
    var_39 = wp::sub(var_37, var_38);
    var_40 = wp::mul(var_8, var_39);
    var_41 = wp::mul(var_y, var_z);
    var_42 = wp::mul(var_x, var_w);
    var_43 = wp::add(var_41, var_42);
    var_44 = wp::mul(var_8, var_43);
    var_46 = wp::mul(var_x, var_x);
    var_47 = wp::mul(var_y, var_y);
    var_48 = wp::add(var_46, var_47);
    var_49 = wp::mul(var_8, var_48);
    var_50 = wp::sub(var_45, var_49);
    var_51 = wp::mat_t<3, 3, wp::float32>(var_14, var_18, var_22, var_26, var_32, var_36, var_40, var_44, var_50);
    return var_51;
}


// /work/main/warpslam/kernels/rays.py:134
static wp::vec_t<2, wp::float32> nearest_and_farthest_0(
    wp::array_t<wp::uint16> var_image,
    wp::int32 var_slot,
    wp::float32 var_scale,
    wp::int32 var_u,
    wp::int32 var_v)
{
    //---------
    // primal vars
    const wp::float32 var_0 = 1e+30;
    wp::float32 var_1;
    const wp::float32 var_2 = 0.0;
    wp::float32 var_3;
    const wp::int32 var_4 = -1;
    const wp::int32 var_5 = -1;
    wp::int32 var_6;
    wp::int32 var_7;
    bool var_8;
    const wp::int32 var_9 = 0;
    bool var_10;
    wp::shape_t* var_11;
    const wp::int32 var_12 = 2;
    wp::int32 var_13;
    wp::shape_t var_14;
    bool var_15;
    const wp::int32 var_16 = 0;
    bool var_17;
    wp::shape_t* var_18;
    const wp::int32 var_19 = 1;
    wp::int32 var_20;
    wp::shape_t var_21;
    bool var_22;
    const wp::float32 var_23 = 0.0;
    const wp::float32 var_24 = 0.0;
    wp::vec_t<2, wp::float32> var_25;
    wp::uint16* var_26;
    wp::float32 var_27;
    wp::uint16 var_28;
    wp::float32 var_29;
    const wp::float32 var_30 = 0.0;
    bool var_31;
    const wp::float32 var_32 = 0.0;
    const wp::float32 var_33 = 0.0;
    wp::vec_t<2, wp::float32> var_34;
    wp::float32 var_35;
    wp::float32 var_36;
    const wp::int32 var_37 = 0;
    wp::int32 var_38;
    wp::int32 var_39;
    bool var_40;
    const wp::int32 var_41 = 0;
    bool var_42;
    wp::shape_t* var_43;
    const wp::int32 var_44 = 2;
    wp::int32 var_45;
    wp::shape_t var_46;
    bool var_47;
    const wp::int32 var_48 = 0;
    bool var_49;
    wp::shape_t* var_50;
    const wp::int32 var_51 = 1;
    wp::int32 var_52;
    wp::shape_t var_53;
    bool var_54;
    const wp::float32 var_55 = 0.0;
    const wp::float32 var_56 = 0.0;
    wp::vec_t<2, wp::float32> var_57;
    wp::uint16* var_58;
    wp::float32 var_59;
    wp::uint16 var_60;
    wp::float32 var_61;
    const wp::float32 var_62 = 0.0;
    bool var_63;
    const wp::float32 var_64 = 0.0;
    const wp::float32 var_65 = 0.0;
    wp::vec_t<2, wp::float32> var_66;
    wp::float32 var_67;
    wp::float32 var_68;
    const wp::int32 var_69 = 1;
    wp::int32 var_70;
    wp::int32 var_71;
    bool var_72;
    const wp::int32 var_73 = 0;
    bool var_74;
    wp::shape_t* var_75;
    const wp::int32 var_76 = 2;
    wp::int32 var_77;
    wp::shape_t var_78;
    bool var_79;
    const wp::int32 var_80 = 0;
    bool var_81;
    wp::shape_t* var_82;
    const wp::int32 var_83 = 1;
    wp::int32 var_84;
    wp::shape_t var_85;
    bool var_86;
    const wp::float32 var_87 = 0.0;
    const wp::float32 var_88 = 0.0;
    wp::vec_t<2, wp::float32> var_89;
    wp::uint16* var_90;
    wp::float32 var_91;
    wp::uint16 var_92;
    wp::float32 var_93;
    const wp::float32 var_94 = 0.0;
    bool var_95;
    const wp::float32 var_96 = 0.0;
    const wp::float32 var_97 = 0.0;
    wp::vec_t<2, wp::float32> var_98;
    wp::float32 var_99;
    wp::float32 var_100;
    const wp::int32 var_101 = 0;
    const wp::int32 var_102 = -1;
    wp::int32 var_103;
    wp::int32 var_104;
    bool var_105;
    const wp::int32 var_106 = 0;
    bool var_107;
    wp::shape_t* var_108;
    const wp::int32 var_109 = 2;
    wp::int32 var_110;
    wp::shape_t var_111;
    bool var_112;
    const wp::int32 var_113 = 0;
    bool var_114;
    wp::shape_t* var_115;
    const wp::int32 var_116 = 1;
    wp::int32 var_117;
    wp::shape_t var_118;
    bool var_119;
    const wp::float32 var_120 = 0.0;
    const wp::float32 var_121 = 0.0;
    wp::vec_t<2, wp::float32> var_122;
    wp::uint16* var_123;
    wp::float32 var_124;
    wp::uint16 var_125;
    wp::float32 var_126;
    const wp::float32 var_127 = 0.0;
    bool var_128;
    const wp::float32 var_129 = 0.0;
    const wp::float32 var_130 = 0.0;
    wp::vec_t<2, wp::float32> var_131;
    wp::float32 var_132;
    wp::float32 var_133;
    const wp::int32 var_134 = 0;
    wp::int32 var_135;
    wp::int32 var_136;
    bool var_137;
    const wp::int32 var_138 = 0;
    bool var_139;
    wp::shape_t* var_140;
    const wp::int32 var_141 = 2;
    wp::int32 var_142;
    wp::shape_t var_143;
    bool var_144;
    const wp::int32 var_145 = 0;
    bool var_146;
    wp::shape_t* var_147;
    const wp::int32 var_148 = 1;
    wp::int32 var_149;
    wp::shape_t var_150;
    bool var_151;
    const wp::float32 var_152 = 0.0;
    const wp::float32 var_153 = 0.0;
    wp::vec_t<2, wp::float32> var_154;
    wp::uint16* var_155;
    wp::float32 var_156;
    wp::uint16 var_157;
    wp::float32 var_158;
    const wp::float32 var_159 = 0.0;
    bool var_160;
    const wp::float32 var_161 = 0.0;
    const wp::float32 var_162 = 0.0;
    wp::vec_t<2, wp::float32> var_163;
    wp::float32 var_164;
    wp::float32 var_165;
    const wp::int32 var_166 = 1;
    wp::int32 var_167;
    wp::int32 var_168;
    bool var_169;
    const wp::int32 var_170 = 0;
    bool var_171;
    wp::shape_t* var_172;
    const wp::int32 var_173 = 2;
    wp::int32 var_174;
    wp::shape_t var_175;
    bool var_176;
    const wp::int32 var_177 = 0;
    bool var_178;
    wp::shape_t* var_179;
    const wp::int32 var_180 = 1;
    wp::int32 var_181;
    wp::shape_t var_182;
    bool var_183;
    const wp::float32 var_184 = 0.0;
    const wp::float32 var_185 = 0.0;
    wp::vec_t<2, wp::float32> var_186;
    wp::uint16* var_187;
    wp::float32 var_188;
    wp::uint16 var_189;
    wp::float32 var_190;
    const wp::float32 var_191 = 0.0;
    bool var_192;
    const wp::float32 var_193 = 0.0;
    const wp::float32 var_194 = 0.0;
    wp::vec_t<2, wp::float32> var_195;
    wp::float32 var_196;
    wp::float32 var_197;
    const wp::int32 var_198 = 1;
    const wp::int32 var_199 = -1;
    wp::int32 var_200;
    wp::int32 var_201;
    bool var_202;
    const wp::int32 var_203 = 0;
    bool var_204;
    wp::shape_t* var_205;
    const wp::int32 var_206 = 2;
    wp::int32 var_207;
    wp::shape_t var_208;
    bool var_209;
    const wp::int32 var_210 = 0;
    bool var_211;
    wp::shape_t* var_212;
    const wp::int32 var_213 = 1;
    wp::int32 var_214;
    wp::shape_t var_215;
    bool var_216;
    const wp::float32 var_217 = 0.0;
    const wp::float32 var_218 = 0.0;
    wp::vec_t<2, wp::float32> var_219;
    wp::uint16* var_220;
    wp::float32 var_221;
    wp::uint16 var_222;
    wp::float32 var_223;
    const wp::float32 var_224 = 0.0;
    bool var_225;
    const wp::float32 var_226 = 0.0;
    const wp::float32 var_227 = 0.0;
    wp::vec_t<2, wp::float32> var_228;
    wp::float32 var_229;
    wp::float32 var_230;
    const wp::int32 var_231 = 0;
    wp::int32 var_232;
    wp::int32 var_233;
    bool var_234;
    const wp::int32 var_235 = 0;
    bool var_236;
    wp::shape_t* var_237;
    const wp::int32 var_238 = 2;
    wp::int32 var_239;
    wp::shape_t var_240;
    bool var_241;
    const wp::int32 var_242 = 0;
    bool var_243;
    wp::shape_t* var_244;
    const wp::int32 var_245 = 1;
    wp::int32 var_246;
    wp::shape_t var_247;
    bool var_248;
    const wp::float32 var_249 = 0.0;
    const wp::float32 var_250 = 0.0;
    wp::vec_t<2, wp::float32> var_251;
    wp::uint16* var_252;
    wp::float32 var_253;
    wp::uint16 var_254;
    wp::float32 var_255;
    const wp::float32 var_256 = 0.0;
    bool var_257;
    const wp::float32 var_258 = 0.0;
    const wp::float32 var_259 = 0.0;
    wp::vec_t<2, wp::float32> var_260;
    wp::float32 var_261;
    wp::float32 var_262;
    const wp::int32 var_263 = 1;
    wp::int32 var_264;
    wp::int32 var_265;
    bool var_266;
    const wp::int32 var_267 = 0;
    bool var_268;
    wp::shape_t* var_269;
    const wp::int32 var_270 = 2;
    wp::int32 var_271;
    wp::shape_t var_272;
    bool var_273;
    const wp::int32 var_274 = 0;
    bool var_275;
    wp::shape_t* var_276;
    const wp::int32 var_277 = 1;
    wp::int32 var_278;
    wp::shape_t var_279;
    bool var_280;
    const wp::float32 var_281 = 0.0;
    const wp::float32 var_282 = 0.0;
    wp::vec_t<2, wp::float32> var_283;
    wp::uint16* var_284;
    wp::float32 var_285;
    wp::uint16 var_286;
    wp::float32 var_287;
    const wp::float32 var_288 = 0.0;
    bool var_289;
    const wp::float32 var_290 = 0.0;
    const wp::float32 var_291 = 0.0;
    wp::vec_t<2, wp::float32> var_292;
    wp::float32 var_293;
    wp::float32 var_294;
    wp::vec_t<2, wp::float32> var_295;
    //---------
    // forward
    // def nearest_and_farthest(                                                              <L 135>
    // least = float(1.0e30)                                                                  <L 139>
    var_1 = wp::float(var_0);
    // largest = float(0.0)                                                                   <L 140>
    var_3 = wp::float(var_2);
    // for dv in range(-1, 2):                                                                <L 141>
    // for du in range(-1, 2):                                                                <L 142>
    // x = u + du                                                                             <L 143>
    var_6 = wp::add(var_u, var_5);
    // y = v + dv                                                                             <L 144>
    var_7 = wp::add(var_v, var_4);
    // if x < 0 or x >= image.shape[2] or y < 0 or y >= image.shape[1]:                       <L 145>
    var_10 = (var_6 < var_9);
    var_8 = var_10;
    if (!var_8) {
        var_11 = &(var_image.shape);
        var_14 = wp::load(var_11);
        var_13 = wp::extract(var_14, var_12);
        var_15 = (var_6 >= var_13);
        var_8 = var_8 || var_15;
    }
    if (!var_8) {
        var_17 = (var_7 < var_16);
        var_8 = var_8 || var_17;
    }
    if (!var_8) {
        var_18 = &(var_image.shape);
        var_21 = wp::load(var_18);
        var_20 = wp::extract(var_21, var_19);
        var_22 = (var_7 >= var_20);
        var_8 = var_8 || var_22;
    }
    if (var_8) {
        // return wp.vec2(0.0, 0.0)                                                           <L 146>
        var_25 = wp::vec_t<2, wp::float32>(var_23, var_24);
        return var_25;
    }
    // depth = float(image[slot, y, x]) * scale                                               <L 147>
    var_26 = wp::address(var_image, var_slot, var_7, var_6);
    var_28 = wp::load(var_26);
    var_27 = wp::float(var_28);
    var_29 = wp::mul(var_27, var_scale);
    // if depth <= 0.0:                                                                       <L 148>
    var_31 = (var_29 <= var_30);
    if (var_31) {
        // return wp.vec2(0.0, 0.0)                                                           <L 149>
        var_34 = wp::vec_t<2, wp::float32>(var_32, var_33);
        return var_34;
    }
    // least = wp.min(least, depth)                                                           <L 150>
    var_35 = wp::min(var_1, var_29);
    // largest = wp.max(largest, depth)                                                       <L 151>
    var_36 = wp::max(var_3, var_29);
    // x = u + du                                                                             <L 143>
    var_38 = wp::add(var_u, var_37);
    // y = v + dv                                                                             <L 144>
    var_39 = wp::add(var_v, var_4);
    // if x < 0 or x >= image.shape[2] or y < 0 or y >= image.shape[1]:                       <L 145>
    var_42 = (var_38 < var_41);
    var_40 = var_42;
    if (!var_40) {
        var_43 = &(var_image.shape);
        var_46 = wp::load(var_43);
        var_45 = wp::extract(var_46, var_44);
        var_47 = (var_38 >= var_45);
        var_40 = var_40 || var_47;
    }
    if (!var_40) {
        var_49 = (var_39 < var_48);
        var_40 = var_40 || var_49;
    }
    if (!var_40) {
        var_50 = &(var_image.shape);
        var_53 = wp::load(var_50);
        var_52 = wp::extract(var_53, var_51);
        var_54 = (var_39 >= var_52);
        var_40 = var_40 || var_54;
    }
    if (var_40) {
        // return wp.vec2(0.0, 0.0)                                                           <L 146>
        var_57 = wp::vec_t<2, wp::float32>(var_55, var_56);
        return var_57;
    }
    // depth = float(image[slot, y, x]) * scale                                               <L 147>
    var_58 = wp::address(var_image, var_slot, var_39, var_38);
    var_60 = wp::load(var_58);
    var_59 = wp::float(var_60);
    var_61 = wp::mul(var_59, var_scale);
    // if depth <= 0.0:                                                                       <L 148>
    var_63 = (var_61 <= var_62);
    if (var_63) {
        // return wp.vec2(0.0, 0.0)                                                           <L 149>
        var_66 = wp::vec_t<2, wp::float32>(var_64, var_65);
        return var_66;
    }
    // least = wp.min(least, depth)                                                           <L 150>
    var_67 = wp::min(var_35, var_61);
    // largest = wp.max(largest, depth)                                                       <L 151>
    var_68 = wp::max(var_36, var_61);
    // x = u + du                                                                             <L 143>
    var_70 = wp::add(var_u, var_69);
    // y = v + dv                                                                             <L 144>
    var_71 = wp::add(var_v, var_4);
    // if x < 0 or x >= image.shape[2] or y < 0 or y >= image.shape[1]:                       <L 145>
    var_74 = (var_70 < var_73);
    var_72 = var_74;
    if (!var_72) {
        var_75 = &(var_image.shape);
        var_78 = wp::load(var_75);
        var_77 = wp::extract(var_78, var_76);
        var_79 = (var_70 >= var_77);
        var_72 = var_72 || var_79;
    }
    if (!var_72) {
        var_81 = (var_71 < var_80);
        var_72 = var_72 || var_81;
    }
    if (!var_72) {
        var_82 = &(var_image.shape);
        var_85 = wp::load(var_82);
        var_84 = wp::extract(var_85, var_83);
        var_86 = (var_71 >= var_84);
        var_72 = var_72 || var_86;
    }
    if (var_72) {
        // return wp.vec2(0.0, 0.0)                                                           <L 146>
        var_89 = wp::vec_t<2, wp::float32>(var_87, var_88);
        return var_89;
    }
    // depth = float(image[slot, y, x]) * scale                                               <L 147>
    var_90 = wp::address(var_image, var_slot, var_71, var_70);
    var_92 = wp::load(var_90);
    var_91 = wp::float(var_92);
    var_93 = wp::mul(var_91, var_scale);
    // if depth <= 0.0:                                                                       <L 148>
    var_95 = (var_93 <= var_94);
    if (var_95) {
        // return wp.vec2(0.0, 0.0)                                                           <L 149>
        var_98 = wp::vec_t<2, wp::float32>(var_96, var_97);
        return var_98;
    }
    // least = wp.min(least, depth)                                                           <L 150>
    var_99 = wp::min(var_67, var_93);
    // largest = wp.max(largest, depth)                                                       <L 151>
    var_100 = wp::max(var_68, var_93);
    // for du in range(-1, 2):                                                                <L 142>
    // x = u + du                                                                             <L 143>
    var_103 = wp::add(var_u, var_102);
    // y = v + dv                                                                             <L 144>
    var_104 = wp::add(var_v, var_101);
    // if x < 0 or x >= image.shape[2] or y < 0 or y >= image.shape[1]:                       <L 145>
    var_107 = (var_103 < var_106);
    var_105 = var_107;
    if (!var_105) {
        var_108 = &(var_image.shape);
        var_111 = wp::load(var_108);
        var_110 = wp::extract(var_111, var_109);
        var_112 = (var_103 >= var_110);
        var_105 = var_105 || var_112;
    }
    if (!var_105) {
        var_114 = (var_104 < var_113);
        var_105 = var_105 || var_114;
    }
    if (!var_105) {
        var_115 = &(var_image.shape);
        var_118 = wp::load(var_115);
        var_117 = wp::extract(var_118, var_116);
        var_119 = (var_104 >= var_117);
        var_105 = var_105 || var_119;
    }
    if (var_105) {
        // return wp.vec2(0.0, 0.0)                                                           <L 146>
        var_122 = wp::vec_t<2, wp::float32>(var_120, var_121);
        return var_122;
    }
    // depth = float(image[slot, y, x]) * scale                                               <L 147>
    var_123 = wp::address(var_image, var_slot, var_104, var_103);
    var_125 = wp::load(var_123);
    var_124 = wp::float(var_125);
    var_126 = wp::mul(var_124, var_scale);
    // if depth <= 0.0:                                                                       <L 148>
    var_128 = (var_126 <= var_127);
    if (var_128) {
        // return wp.vec2(0.0, 0.0)                                                           <L 149>
        var_131 = wp::vec_t<2, wp::float32>(var_129, var_130);
        return var_131;
    }
    // least = wp.min(least, depth)                                                           <L 150>
    var_132 = wp::min(var_99, var_126);
    // largest = wp.max(largest, depth)                                                       <L 151>
    var_133 = wp::max(var_100, var_126);
    // x = u + du                                                                             <L 143>
    var_135 = wp::add(var_u, var_134);
    // y = v + dv                                                                             <L 144>
    var_136 = wp::add(var_v, var_101);
    // if x < 0 or x >= image.shape[2] or y < 0 or y >= image.shape[1]:                       <L 145>
    var_139 = (var_135 < var_138);
    var_137 = var_139;
    if (!var_137) {
        var_140 = &(var_image.shape);
        var_143 = wp::load(var_140);
        var_142 = wp::extract(var_143, var_141);
        var_144 = (var_135 >= var_142);
        var_137 = var_137 || var_144;
    }
    if (!var_137) {
        var_146 = (var_136 < var_145);
        var_137 = var_137 || var_146;
    }
    if (!var_137) {
        var_147 = &(var_image.shape);
        var_150 = wp::load(var_147);
        var_149 = wp::extract(var_150, var_148);
        var_151 = (var_136 >= var_149);
        var_137 = var_137 || var_151;
    }
    if (var_137) {
        // return wp.vec2(0.0, 0.0)                                                           <L 146>
        var_154 = wp::vec_t<2, wp::float32>(var_152, var_153);
        return var_154;
    }
    // depth = float(image[slot, y, x]) * scale                                               <L 147>
    var_155 = wp::address(var_image, var_slot, var_136, var_135);
    var_157 = wp::load(var_155);
    var_156 = wp::float(var_157);
    var_158 = wp::mul(var_156, var_scale);
    // if depth <= 0.0:                                                                       <L 148>
    var_160 = (var_158 <= var_159);
    if (var_160) {
        // return wp.vec2(0.0, 0.0)                                                           <L 149>
        var_163 = wp::vec_t<2, wp::float32>(var_161, var_162);
        return var_163;
    }
    // least = wp.min(least, depth)                                                           <L 150>
    var_164 = wp::min(var_132, var_158);
    // largest = wp.max(largest, depth)                                                       <L 151>
    var_165 = wp::max(var_133, var_158);
    // x = u + du                                                                             <L 143>
    var_167 = wp::add(var_u, var_166);
    // y = v + dv                                                                             <L 144>
    var_168 = wp::add(var_v, var_101);
    // if x < 0 or x >= image.shape[2] or y < 0 or y >= image.shape[1]:                       <L 145>
    var_171 = (var_167 < var_170);
    var_169 = var_171;
    if (!var_169) {
        var_172 = &(var_image.shape);
        var_175 = wp::load(var_172);
        var_174 = wp::extract(var_175, var_173);
        var_176 = (var_167 >= var_174);
        var_169 = var_169 || var_176;
    }
    if (!var_169) {
        var_178 = (var_168 < var_177);
        var_169 = var_169 || var_178;
    }
    if (!var_169) {
        var_179 = &(var_image.shape);
        var_182 = wp::load(var_179);
        var_181 = wp::extract(var_182, var_180);
        var_183 = (var_168 >= var_181);
        var_169 = var_169 || var_183;
    }
    if (var_169) {
        // return wp.vec2(0.0, 0.0)                                                           <L 146>
        var_186 = wp::vec_t<2, wp::float32>(var_184, var_185);
        return var_186;
    }
    // depth = float(image[slot, y, x]) * scale                                               <L 147>
    var_187 = wp::address(var_image, var_slot, var_168, var_167);
    var_189 = wp::load(var_187);
    var_188 = wp::float(var_189);
    var_190 = wp::mul(var_188, var_scale);
    // if depth <= 0.0:                                                                       <L 148>
    var_192 = (var_190 <= var_191);
    if (var_192) {
        // return wp.vec2(0.0, 0.0)                                                           <L 149>
        var_195 = wp::vec_t<2, wp::float32>(var_193, var_194);
        return var_195;
    }
    // least = wp.min(least, depth)                                                           <L 150>
    var_196 = wp::min(var_164, var_190);
    // largest = wp.max(largest, depth)                                                       <L 151>
    var_197 = wp::max(var_165, var_190);
    // for du in range(-1, 2):                                                                <L 142>
    // x = u + du                                                                             <L 143>
    var_200 = wp::add(var_u, var_199);
    // y = v + dv                                                                             <L 144>
    var_201 = wp::add(var_v, var_198);
    // if x < 0 or x >= image.shape[2] or y < 0 or y >= image.shape[1]:                       <L 145>
    var_204 = (var_200 < var_203);
    var_202 = var_204;
    if (!var_202) {
        var_205 = &(var_image.shape);
        var_208 = wp::load(var_205);
        var_207 = wp::extract(var_208, var_206);
        var_209 = (var_200 >= var_207);
        var_202 = var_202 || var_209;
    }
    if (!var_202) {
        var_211 = (var_201 < var_210);
        var_202 = var_202 || var_211;
    }
    if (!var_202) {
        var_212 = &(var_image.shape);
        var_215 = wp::load(var_212);
        var_214 = wp::extract(var_215, var_213);
        var_216 = (var_201 >= var_214);
        var_202 = var_202 || var_216;
    }
    if (var_202) {
        // return wp.vec2(0.0, 0.0)                                                           <L 146>
        var_219 = wp::vec_t<2, wp::float32>(var_217, var_218);
        return var_219;
    }
    // depth = float(image[slot, y, x]) * scale                                               <L 147>
    var_220 = wp::address(var_image, var_slot, var_201, var_200);
    var_222 = wp::load(var_220);
    var_221 = wp::float(var_222);
    var_223 = wp::mul(var_221, var_scale);
    // if depth <= 0.0:                                                                       <L 148>
    var_225 = (var_223 <= var_224);
    if (var_225) {
        // return wp.vec2(0.0, 0.0)                                                           <L 149>
        var_228 = wp::vec_t<2, wp::float32>(var_226, var_227);
        return var_228;
    }
    // least = wp.min(least, depth)                                                           <L 150>
    var_229 = wp::min(var_196, var_223);
    // largest = wp.max(largest, depth)                                                       <L 151>
    var_230 = wp::max(var_197, var_223);
    // x = u + du                                                                             <L 143>
    var_232 = wp::add(var_u, var_231);
    // y = v + dv                                                                             <L 144>
    var_233 = wp::add(var_v, var_198);
    // if x < 0 or x >= image.shape[2] or y < 0 or y >= image.shape[1]:                       <L 145>
    var_236 = (var_232 < var_235);
    var_234 = var_236;
    if (!var_234) {
        var_237 = &(var_image.shape);
        var_240 = wp::load(var_237);
        var_239 = wp::extract(var_240, var_238);
        var_241 = (var_232 >= var_239);
        var_234 = var_234 || var_241;
    }
    if (!var_234) {
        var_243 = (var_233 < var_242);
        var_234 = var_234 || var_243;
    }
    if (!var_234) {
        var_244 = &(var_image.shape);
        var_247 = wp::load(var_244);
        var_246 = wp::extract(var_247, var_245);
        var_248 = (var_233 >= var_246);
        var_234 = var_234 || var_248;
    }
    if (var_234) {
        // return wp.vec2(0.0, 0.0)                                                           <L 146>
        var_251 = wp::vec_t<2, wp::float32>(var_249, var_250);
        return var_251;
    }
    // depth = float(image[slot, y, x]) * scale                                               <L 147>
    var_252 = wp::address(var_image, var_slot, var_233, var_232);
    var_254 = wp::load(var_252);
    var_253 = wp::float(var_254);
    var_255 = wp::mul(var_253, var_scale);
    // if depth <= 0.0:                                                                       <L 148>
    var_257 = (var_255 <= var_256);
    if (var_257) {
        // return wp.vec2(0.0, 0.0)                                                           <L 149>
        var_260 = wp::vec_t<2, wp::float32>(var_258, var_259);
        return var_260;
    }
    // least = wp.min(least, depth)                                                           <L 150>
    var_261 = wp::min(var_229, var_255);
    // largest = wp.max(largest, depth)                                                       <L 151>
    var_262 = wp::max(var_230, var_255);
    // x = u + du                                                                             <L 143>
    var_264 = wp::add(var_u, var_263);
    // y = v + dv                                                                             <L 144>
    var_265 = wp::add(var_v, var_198);
    // if x < 0 or x >= image.shape[2] or y < 0 or y >= image.shape[1]:                       <L 145>
    var_268 = (var_264 < var_267);
    var_266 = var_268;
    if (!var_266) {
        var_269 = &(var_image.shape);
        var_272 = wp::load(var_269);
        var_271 = wp::extract(var_272, var_270);
        var_273 = (var_264 >= var_271);
        var_266 = var_266 || var_273;
    }
    if (!var_266) {
        var_275 = (var_265 < var_274);
        var_266 = var_266 || var_275;
    }
    if (!var_266) {
        var_276 = &(var_image.shape);
        var_279 = wp::load(var_276);
        var_278 = wp::extract(var_279, var_277);
        var_280 = (var_265 >= var_278);
        var_266 = var_266 || var_280;
    }
    if (var_266) {
        // return wp.vec2(0.0, 0.0)                                                           <L 146>
        var_283 = wp::vec_t<2, wp::float32>(var_281, var_282);
        return var_283;
    }
    // depth = float(image[slot, y, x]) * scale                                               <L 147>
    var_284 = wp::address(var_image, var_slot, var_265, var_264);
    var_286 = wp::load(var_284);
    var_285 = wp::float(var_286);
    var_287 = wp::mul(var_285, var_scale);
    // if depth <= 0.0:                                                                       <L 148>
    var_289 = (var_287 <= var_288);
    if (var_289) {
        // return wp.vec2(0.0, 0.0)                                                           <L 149>
        var_292 = wp::vec_t<2, wp::float32>(var_290, var_291);
        return var_292;
    }
    // least = wp.min(least, depth)                                                           <L 150>
    var_293 = wp::min(var_261, var_287);
    // largest = wp.max(largest, depth)                                                       <L 151>
    var_294 = wp::max(var_262, var_287);
    // return wp.vec2(least, largest)                                                         <L 152>
    var_295 = wp::vec_t<2, wp::float32>(var_293, var_294);
    return var_295;
}


// /work/main/warpslam/kernels/rays.py:282
static void adj_fraction_0(
    wp::int32 var_k,
    wp::int32 var_count,
    wp::int32 var_jitter,
    wp::uint32 var_state,
    wp::int32 & adj_k,
    wp::int32 & adj_count,
    wp::int32 & adj_jitter,
    wp::uint32 & adj_state,
    wp::float32 & adj_ret)
{
	// reverse mode disabled (no backward-enabled kernel depends on this function)
}


// /work/main/warpslam/kernels/rays.py:295
static void adj_stratum_0(
    wp::int32 var_k,
    wp::int32 var_count,
    wp::float32 var_near,
    wp::float32 var_far,
    wp::int32 var_jitter,
    wp::uint32 var_state,
    wp::int32 & adj_k,
    wp::int32 & adj_count,
    wp::float32 & adj_near,
    wp::float32 & adj_far,
    wp::int32 & adj_jitter,
    wp::uint32 & adj_state,
    wp::float32 & adj_ret)
{
	// reverse mode disabled (no backward-enabled kernel depends on this function)
}


// /work/main/warpslam/kernels/rays.py:301
static void adj_surface_sample_0(
    wp::int32 var_k,
    wp::int32 var_count,
    wp::float32 var_depth,
    wp::float32 var_max_depth,
    wp::int32 var_jitter,
    wp::uint32 var_state,
    wp::int32 & adj_k,
    wp::int32 & adj_count,
    wp::float32 & adj_depth,
    wp::float32 & adj_max_depth,
    wp::int32 & adj_jitter,
    wp::uint32 & adj_state,
    wp::float32 & adj_ret)
{
	// reverse mode disabled (no backward-enabled kernel depends on this function)
}


// /work/main/warpslam/kernels/rays.py:310
static void adj_place_ray_0(
    wp::int32 var_tid,
    wp::int32 var_count,
    wp::int32 var_surface_count,
    wp::float32 var_near,
    wp::float32 var_far,
    wp::float32 var_depth,
    wp::float32 var_max_depth,
    wp::int32 var_jitter,
    wp::uint32 var_state,
    wp::array_t<wp::float32> var_z,
    wp::int32 & adj_tid,
    wp::int32 & adj_count,
    wp::int32 & adj_surface_count,
    wp::float32 & adj_near,
    wp::float32 & adj_far,
    wp::float32 & adj_depth,
    wp::float32 & adj_max_depth,
    wp::int32 & adj_jitter,
    wp::uint32 & adj_state,
    wp::array_t<wp::float32> & adj_z)
{
	// reverse mode disabled (no backward-enabled kernel depends on this function)
}


// /work/main/warpslam/kernels/rays.py:34
static void adj_pixel_direction_0(
    wp::int32 var_u,
    wp::int32 var_v,
    wp::vec_t<2, wp::float32> var_focal,
    wp::vec_t<2, wp::float32> var_center,
    wp::int32 & adj_u,
    wp::int32 & adj_v,
    wp::vec_t<2, wp::float32> & adj_focal,
    wp::vec_t<2, wp::float32> & adj_center,
    wp::vec_t<3, wp::float32> & adj_ret)
{
	// reverse mode disabled (no backward-enabled kernel depends on this function)
}


// /work/main/warpslam/kernels/rays.py:39
static void adj_cell_pixel_0(
    wp::int32 var_cell,
    wp::vec_t<2, wp::int32> var_cells,
    wp::int32 var_width,
    wp::int32 var_height,
    wp::float32 var_x,
    wp::float32 var_y,
    wp::int32 & adj_cell,
    wp::vec_t<2, wp::int32> & adj_cells,
    wp::int32 & adj_width,
    wp::int32 & adj_height,
    wp::float32 & adj_x,
    wp::float32 & adj_y,
    wp::vec_t<2, wp::int32> & adj_ret)
{
	// reverse mode disabled (no backward-enabled kernel depends on this function)
}


// /work/main/warpslam/kernels/rays.py:24
static void adj_rotation_from_quaternion_0(
    wp::float32 var_w,
    wp::float32 var_x,
    wp::float32 var_y,
    wp::float32 var_z,
    wp::float32 & adj_w,
    wp::float32 & adj_x,
    wp::float32 & adj_y,
    wp::float32 & adj_z,
    wp::mat_t<3, 3, wp::float32> & adj_ret)
{
    //---------
    // primal vars
    const wp::float32 var_0 = 2.0;
    wp::float32 var_1;
    wp::float32 var_2;
    wp::float32 var_3;
    wp::float32 var_4;
    wp::float32 var_5;
    wp::float32 var_6;
    wp::float32 var_7;
    wp::float32 var_8;
    const wp::float32 var_9 = 1.0;
    wp::float32 var_10;
    wp::float32 var_11;
    wp::float32 var_12;
    wp::float32 var_13;
    wp::float32 var_14;
    wp::float32 var_15;
    wp::float32 var_16;
    wp::float32 var_17;
    wp::float32 var_18;
    wp::float32 var_19;
    wp::float32 var_20;
    wp::float32 var_21;
    wp::float32 var_22;
    wp::float32 var_23;
    wp::float32 var_24;
    wp::float32 var_25;
    wp::float32 var_26;
    const wp::float32 var_27 = 1.0;
    wp::float32 var_28;
    wp::float32 var_29;
    wp::float32 var_30;
    wp::float32 var_31;
    wp::float32 var_32;
    wp::float32 var_33;
    wp::float32 var_34;
    wp::float32 var_35;
    wp::float32 var_36;
    wp::float32 var_37;
    wp::float32 var_38;
    wp::float32 var_39;
    wp::float32 var_40;
    wp::float32 var_41;
    wp::float32 var_42;
    wp::float32 var_43;
    wp::float32 var_44;
    const wp::float32 var_45 = 1.0;
    wp::float32 var_46;
    wp::float32 var_47;
    wp::float32 var_48;
    wp::float32 var_49;
    wp::float32 var_50;
    wp::mat_t<3, 3, wp::float32> var_51;
    //---------
    // dual vars
    wp::float32 adj_0 = {};
    wp::float32 adj_1 = {};
    wp::float32 adj_2 = {};
    wp::float32 adj_3 = {};
    wp::float32 adj_4 = {};
    wp::float32 adj_5 = {};
    wp::float32 adj_6 = {};
    wp::float32 adj_7 = {};
    wp::float32 adj_8 = {};
    wp::float32 adj_9 = {};
    wp::float32 adj_10 = {};
    wp::float32 adj_11 = {};
    wp::float32 adj_12 = {};
    wp::float32 adj_13 = {};
    wp::float32 adj_14 = {};
    wp::float32 adj_15 = {};
    wp::float32 adj_16 = {};
    wp::float32 adj_17 = {};
    wp::float32 adj_18 = {};
    wp::float32 adj_19 = {};
    wp::float32 adj_20 = {};
    wp::float32 adj_21 = {};
    wp::float32 adj_22 = {};
    wp::float32 adj_23 = {};
    wp::float32 adj_24 = {};
    wp::float32 adj_25 = {};
    wp::float32 adj_26 = {};
    wp::float32 adj_27 = {};
    wp::float32 adj_28 = {};
    wp::float32 adj_29 = {};
    wp::float32 adj_30 = {};
    wp::float32 adj_31 = {};
    wp::float32 adj_32 = {};
    wp::float32 adj_33 = {};
    wp::float32 adj_34 = {};
    wp::float32 adj_35 = {};
    wp::float32 adj_36 = {};
    wp::float32 adj_37 = {};
    wp::float32 adj_38 = {};
    wp::float32 adj_39 = {};
    wp::float32 adj_40 = {};
    wp::float32 adj_41 = {};
    wp::float32 adj_42 = {};
    wp::float32 adj_43 = {};
    wp::float32 adj_44 = {};
    wp::float32 adj_45 = {};
    wp::float32 adj_46 = {};
    wp::float32 adj_47 = {};
    wp::float32 adj_48 = {};
    wp::float32 adj_49 = {};
    wp::float32 adj_50 = {};
    wp::mat_t<3, 3, wp::float32> adj_51 = {};
    //---------
    // forward
    // def rotation_from_quaternion(w: float, x: float, y: float, z: float) -> wp.mat33:       <L 25>
    // s = 2.0 / (w * w + x * x + y * y + z * z)                                              <L 26>
    var_1 = wp::mul(var_w, var_w);
    var_2 = wp::mul(var_x, var_x);
    var_3 = wp::add(var_1, var_2);
    var_4 = wp::mul(var_y, var_y);
    var_5 = wp::add(var_3, var_4);
    var_6 = wp::mul(var_z, var_z);
    var_7 = wp::add(var_5, var_6);
    var_8 = wp::div(var_0, var_7);
    // return wp.mat33(                                                                       <L 27>
    // 1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),                   <L 28>
    var_10 = wp::mul(var_y, var_y);
    var_11 = wp::mul(var_z, var_z);
    var_12 = wp::add(var_10, var_11);
    var_13 = wp::mul(var_8, var_12);
    var_14 = wp::sub(var_9, var_13);
    var_15 = wp::mul(var_x, var_y);
    var_16 = wp::mul(var_z, var_w);
    var_17 = wp::sub(var_15, var_16);
    var_18 = wp::mul(var_8, var_17);
    var_19 = wp::mul(var_x, var_z);
    var_20 = wp::mul(var_y, var_w);
    var_21 = wp::add(var_19, var_20);
    var_22 = wp::mul(var_8, var_21);
    // s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w),                   <L 29>
    var_23 = wp::mul(var_x, var_y);
    var_24 = wp::mul(var_z, var_w);
    var_25 = wp::add(var_23, var_24);
    var_26 = wp::mul(var_8, var_25);
    var_28 = wp::mul(var_x, var_x);
    var_29 = wp::mul(var_z, var_z);
    var_30 = wp::add(var_28, var_29);
    var_31 = wp::mul(var_8, var_30);
    var_32 = wp::sub(var_27, var_31);
    var_33 = wp::mul(var_y, var_z);
    var_34 = wp::mul(var_x, var_w);
    var_35 = wp::sub(var_33, var_34);
    var_36 = wp::mul(var_8, var_35);
    // s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y),                   <L 30>
    var_37 = wp::mul(var_x, var_z);
    var_38 = wp::mul(var_y, var_w);
    var_39 = wp::sub(var_37, var_38);
    var_40 = wp::mul(var_8, var_39);
    var_41 = wp::mul(var_y, var_z);
    var_42 = wp::mul(var_x, var_w);
    var_43 = wp::add(var_41, var_42);
    var_44 = wp::mul(var_8, var_43);
    var_46 = wp::mul(var_x, var_x);
    var_47 = wp::mul(var_y, var_y);
    var_48 = wp::add(var_46, var_47);
    var_49 = wp::mul(var_8, var_48);
    var_50 = wp::sub(var_45, var_49);
    var_51 = wp::mat_t<3, 3, wp::float32>(var_14, var_18, var_22, var_26, var_32, var_36, var_40, var_44, var_50);
    goto label0;
    //---------
    // reverse
    label0:;
    adj_51 += adj_ret;
    wp::adj_mat_t(var_14, var_18, var_22, var_26, var_32, var_36, var_40, var_44, var_50, adj_14, adj_18, adj_22, adj_26, adj_32, adj_36, adj_40, adj_44, adj_50, adj_51);
    wp::adj_sub(var_45, var_49, adj_45, adj_49, adj_50);
    wp::adj_mul(var_8, var_48, adj_8, adj_48, adj_49);
    wp::adj_add(var_46, var_47, adj_46, adj_47, adj_48);
    wp::adj_mul(var_y, var_y, adj_y, adj_y, adj_47);
    wp::adj_mul(var_x, var_x, adj_x, adj_x, adj_46);
    wp::adj_mul(var_8, var_43, adj_8, adj_43, adj_44);
    wp::adj_add(var_41, var_42, adj_41, adj_42, adj_43);
    wp::adj_mul(var_x, var_w, adj_x, adj_w, adj_42);
    wp::adj_mul(var_y, var_z, adj_y, adj_z, adj_41);
    wp::adj_mul(var_8, var_39, adj_8, adj_39, adj_40);
    wp::adj_sub(var_37, var_38, adj_37, adj_38, adj_39);
    wp::adj_mul(var_y, var_w, adj_y, adj_w, adj_38);
    wp::adj_mul(var_x, var_z, adj_x, adj_z, adj_37);
    // adj: s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y),              <L 30>
    wp::adj_mul(var_8, var_35, adj_8, adj_35, adj_36);
    wp::adj_sub(var_33, var_34, adj_33, adj_34, adj_35);
    wp::adj_mul(var_x, var_w, adj_x, adj_w, adj_34);
    wp::adj_mul(var_y, var_z, adj_y, adj_z, adj_33);
    wp::adj_sub(var_27, var_31, adj_27, adj_31, adj_32);
    wp::adj_mul(var_8, var_30, adj_8, adj_30, adj_31);
    wp::adj_add(var_28, var_29, adj_28, adj_29, adj_30);
    wp::adj_mul(var_z, var_z, adj_z, adj_z, adj_29);
    wp::adj_mul(var_x, var_x, adj_x, adj_x, adj_28);
    wp::adj_mul(var_8, var_25, adj_8, adj_25, adj_26);
    wp::adj_add(var_23, var_24, adj_23, adj_24, adj_25);
    wp::adj_mul(var_z, var_w, adj_z, adj_w, adj_24);
    wp::adj_mul(var_x, var_y, adj_x, adj_y, adj_23);
    // adj: s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w),              <L 29>
    wp::adj_mul(var_8, var_21, adj_8, adj_21, adj_22);
    wp::adj_add(var_19, var_20, adj_19, adj_20, adj_21);
    wp::adj_mul(var_y, var_w, adj_y, adj_w, adj_20);
    wp::adj_mul(var_x, var_z, adj_x, adj_z, adj_19);
    wp::adj_mul(var_8, var_17, adj_8, adj_17, adj_18);
    wp::adj_sub(var_15, var_16, adj_15, adj_16, adj_17);
    wp::adj_mul(var_z, var_w, adj_z, adj_w, adj_16);
    wp::adj_mul(var_x, var_y, adj_x, adj_y, adj_15);
    wp::adj_sub(var_9, var_13, adj_9, adj_13, adj_14);
    wp::adj_mul(var_8, var_12, adj_8, adj_12, adj_13);
    wp::adj_add(var_10, var_11, adj_10, adj_11, adj_12);
    wp::adj_mul(var_z, var_z, adj_z, adj_z, adj_11);
    wp::adj_mul(var_y, var_y, adj_y, adj_y, adj_10);
    // adj: 1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),              <L 28>
    // adj: return wp.mat33(                                                                  <L 27>
    wp::adj_div(var_0, var_7, var_8, adj_0, adj_7, adj_8);
    wp::adj_add(var_5, var_6, adj_5, adj_6, adj_7);
    wp::adj_mul(var_z, var_z, adj_z, adj_z, adj_6);
    wp::adj_add(var_3, var_4, adj_3, adj_4, adj_5);
    wp::adj_mul(var_y, var_y, adj_y, adj_y, adj_4);
    wp::adj_add(var_1, var_2, adj_1, adj_2, adj_3);
    wp::adj_mul(var_x, var_x, adj_x, adj_x, adj_2);
    wp::adj_mul(var_w, var_w, adj_w, adj_w, adj_1);
    // adj: s = 2.0 / (w * w + x * x + y * y + z * z)                                         <L 26>
    // adj: def rotation_from_quaternion(w: float, x: float, y: float, z: float) -> wp.mat33:  <L 25>
    return;
}


// /work/main/warpslam/kernels/rays.py:134
static void adj_nearest_and_farthest_0(
    wp::array_t<wp::uint16> var_image,
    wp::int32 var_slot,
    wp::float32 var_scale,
    wp::int32 var_u,
    wp::int32 var_v,
    wp::array_t<wp::uint16> & adj_image,
    wp::int32 & adj_slot,
    wp::float32 & adj_scale,
    wp::int32 & adj_u,
    wp::int32 & adj_v,
    wp::vec_t<2, wp::float32> & adj_ret)
{
	// reverse mode disabled (no backward-enabled kernel depends on this function)
}

struct wp_args_accumulate_errors_1b100291 {
    wp::int32 cell_count;
    wp::float32 largest;
    wp::array_t<wp::int32> keep;
    wp::array_t<wp::float32> measured_depth;
    wp::array_t<wp::float32> depth;
    wp::array_t<wp::float32> cumulative_error;
};


template <bool wp_linear_contiguous>
static void accumulate_errors_1b100291_cpu_kernel_forward(
    wp::launch_bounds_t<1> dim,
    size_t task_index,
    wp_args_accumulate_errors_1b100291 *_wp_args)
{
    static constexpr bool wp_linear_tid = wp_linear_contiguous;

    //---------
    // argument vars
    wp::int32 var_cell_count = _wp_args->cell_count;
    wp::float32 var_largest = _wp_args->largest;
    wp::array_t<wp::int32> var_keep = _wp_args->keep;
    wp::array_t<wp::float32> var_measured_depth = _wp_args->measured_depth;
    wp::array_t<wp::float32> var_depth = _wp_args->depth;
    wp::array_t<wp::float32> var_cumulative_error = _wp_args->cumulative_error;
    //---------
    // primal vars
    wp::int32 var_0;
    const wp::float32 var_1 = 0.0;
    wp::float32 var_2;
    wp::range_t var_3;
    wp::int32 var_4;
    wp::int32 var_5;
    wp::int32 var_6;
    const wp::float32 var_7 = 1e-06;
    wp::float32 var_8;
    bool var_9;
    wp::int32* var_10;
    const wp::int32 var_11 = 0;
    bool var_12;
    wp::int32 var_13;
    wp::float32* var_14;
    const wp::float32 var_15 = 0.0;
    bool var_16;
    wp::float32 var_17;
    wp::float32* var_18;
    wp::float32* var_19;
    wp::float32 var_20;
    wp::float32 var_21;
    wp::float32 var_22;
    wp::float32 var_23;
    wp::float32 var_24;
    wp::float32 var_25;
    wp::float32 var_26;
    //---------
    // forward
    // def accumulate_errors(                                                                 <L 200>
    // f = wp.tid()                                                                           <L 209>
    var_0 = builtin_tid1d();
    // total = float(0.0)                                                                     <L 210>
    var_2 = wp::float(var_1);
    // for c in range(cell_count):                                                            <L 211>
    var_3 = wp::range(var_cell_count);
    start_for_0:;
        if (iter_cmp(var_3) == 0) goto end_for_0;
        var_4 = wp::iter_next(var_3);
        // n = f * cell_count + c                                                             <L 212>
        var_5 = wp::mul(var_0, var_cell_count);
        var_6 = wp::add(var_5, var_4);
        // total += 1.0e-6                                                                    <L 214>
        var_8 = wp::add(var_2, var_7);
        // if keep[n] != 0 and measured_depth[n] > 0.0:                                       <L 215>
        var_10 = wp::address(var_keep, var_6);
        var_13 = wp::load(var_10);
        var_12 = (var_13 != var_11);
        var_9 = var_12;
        if (var_9) {
            var_14 = wp::address(var_measured_depth, var_6);
            var_17 = wp::load(var_14);
            var_16 = (var_17 > var_15);
            var_9 = var_9 && var_16;
        }
        if (var_9) {
            // total += wp.min(wp.abs(measured_depth[n] - depth[n]), largest)                 <L 216>
            var_18 = wp::address(var_measured_depth, var_6);
            var_19 = wp::address(var_depth, var_6);
            var_21 = wp::load(var_18);
            var_22 = wp::load(var_19);
            var_20 = wp::sub(var_21, var_22);
            var_23 = wp::abs(var_20);
            var_24 = wp::min(var_23, var_largest);
            var_25 = wp::add(var_8, var_24);
        }
        var_26 = wp::where(var_9, var_25, var_8);
        // cumulative_error[f, c] = total                                                     <L 217>
        wp::array_store(var_cumulative_error, var_0, var_4, var_26);
        wp::assign(var_2, var_26);
        goto start_for_0;
    end_for_0:;
}



template <bool wp_linear_contiguous>
static WP_FORCEINLINE void accumulate_errors_1b100291_cpu_forward_tasks(
    wp::launch_bounds_t<1> *dim,
    wp_args_accumulate_errors_1b100291 *_wp_args)
{
    for (size_t task_index = 0; task_index < dim->size; ++task_index)
    {
        accumulate_errors_1b100291_cpu_kernel_forward<wp_linear_contiguous>(*dim, task_index, _wp_args);
    }
}

static WP_FORCEINLINE void accumulate_errors_1b100291_cpu_forward_dispatch(
    wp::launch_bounds_t<1> *dim,
    wp_args_accumulate_errors_1b100291 *_wp_args)
{
    wp::tile_shared_storage_t tile_mem;
#if defined(WP_ENABLE_TILES_IN_STACK_MEMORY)
    wp::shared_tile_storage = &tile_mem;
#endif

    accumulate_errors_1b100291_cpu_forward_tasks<false>(dim, _wp_args);
}

extern "C" {

// Python CPU entry points
WP_API void accumulate_errors_1b100291_cpu_forward(
    wp::launch_bounds_t<1> *dim,
    wp_args_accumulate_errors_1b100291 *_wp_args)
{
    accumulate_errors_1b100291_cpu_forward_dispatch(dim, _wp_args);
}

} // extern C

struct wp_args_bound_rays_4ad32ab6 {
    wp::vec_t<3, wp::float32> low;
    wp::vec_t<3, wp::float32> high;
    wp::array_t<wp::vec_t<3, wp::float32>> ray_origin;
    wp::array_t<wp::vec_t<3, wp::float32>> ray_direction;
    wp::array_t<wp::float32> depth;
    wp::int32 use_depth;
    wp::array_t<wp::float32> t_exit;
    wp::array_t<wp::int32> keep;
    wp::array_t<wp::float32> max_depth;
};


template <bool wp_linear_contiguous>
static void bound_rays_4ad32ab6_cpu_kernel_forward(
    wp::launch_bounds_t<1> dim,
    size_t task_index,
    wp_args_bound_rays_4ad32ab6 *_wp_args)
{
    static constexpr bool wp_linear_tid = wp_linear_contiguous;
    wp_args_bound_rays_4ad32ab6 wp_contiguous_args;
    if constexpr (wp_linear_contiguous)
    {
        wp_contiguous_args = *_wp_args;
        wp_contiguous_args.ray_origin.strides[0] = sizeof(wp::vec_t<3, wp::float32>);
        wp_contiguous_args.ray_direction.strides[0] = sizeof(wp::vec_t<3, wp::float32>);
        wp_contiguous_args.depth.strides[0] = sizeof(wp::float32);
        wp_contiguous_args.t_exit.strides[0] = sizeof(wp::float32);
        wp_contiguous_args.keep.strides[0] = sizeof(wp::int32);
        wp_contiguous_args.max_depth.strides[0] = sizeof(wp::float32);
        _wp_args = &wp_contiguous_args;
    }
    //---------
    // argument vars
    wp::vec_t<3, wp::float32> var_low = _wp_args->low;
    wp::vec_t<3, wp::float32> var_high = _wp_args->high;
    wp::array_t<wp::vec_t<3, wp::float32>> var_ray_origin = _wp_args->ray_origin;
    wp::array_t<wp::vec_t<3, wp::float32>> var_ray_direction = _wp_args->ray_direction;
    wp::array_t<wp::float32> var_depth = _wp_args->depth;
    wp::int32 var_use_depth = _wp_args->use_depth;
    wp::array_t<wp::float32> var_t_exit = _wp_args->t_exit;
    wp::array_t<wp::int32> var_keep = _wp_args->keep;
    wp::array_t<wp::float32> var_max_depth = _wp_args->max_depth;
    //---------
    // primal vars
    wp::int32 var_0;
    wp::vec_t<3, wp::float32>* var_1;
    wp::vec_t<3, wp::float32> var_2;
    wp::vec_t<3, wp::float32> var_3;
    wp::vec_t<3, wp::float32>* var_4;
    wp::vec_t<3, wp::float32> var_5;
    wp::vec_t<3, wp::float32> var_6;
    const wp::float32 var_7 = 10000000000.0;
    wp::float32 var_8;
    const wp::int32 var_9 = 0;
    wp::float32 var_10;
    const wp::float32 var_11 = 0.0;
    bool var_12;
    wp::float32 var_13;
    wp::float32 var_14;
    wp::float32 var_15;
    wp::float32 var_16;
    wp::float32 var_17;
    wp::float32 var_18;
    wp::float32 var_19;
    wp::float32 var_20;
    wp::float32 var_21;
    wp::float32 var_22;
    wp::float32 var_23;
    wp::float32 var_24;
    wp::float32 var_25;
    const wp::int32 var_26 = 1;
    wp::float32 var_27;
    const wp::float32 var_28 = 0.0;
    bool var_29;
    wp::float32 var_30;
    wp::float32 var_31;
    wp::float32 var_32;
    wp::float32 var_33;
    wp::float32 var_34;
    wp::float32 var_35;
    wp::float32 var_36;
    wp::float32 var_37;
    wp::float32 var_38;
    wp::float32 var_39;
    wp::float32 var_40;
    wp::float32 var_41;
    wp::float32 var_42;
    const wp::int32 var_43 = 2;
    wp::float32 var_44;
    const wp::float32 var_45 = 0.0;
    bool var_46;
    wp::float32 var_47;
    wp::float32 var_48;
    wp::float32 var_49;
    wp::float32 var_50;
    wp::float32 var_51;
    wp::float32 var_52;
    wp::float32 var_53;
    wp::float32 var_54;
    wp::float32 var_55;
    wp::float32 var_56;
    wp::float32 var_57;
    wp::float32 var_58;
    wp::float32 var_59;
    const wp::int32 var_60 = 1;
    wp::int32 var_61;
    const wp::int32 var_62 = 0;
    bool var_63;
    wp::float32* var_64;
    bool var_65;
    wp::float32 var_66;
    const wp::int32 var_67 = 1;
    const wp::int32 var_68 = 0;
    wp::int32 var_69;
    const wp::int32 var_70 = 1;
    bool var_71;
    const wp::int32 var_72 = 0;
    wp::float32* var_73;
    wp::float32 var_74;
    wp::float32 var_75;
    wp::int32 var_76;
    //---------
    // forward
    // def bound_rays(                                                                        <L 254>
    // tid = wp.tid()                                                                         <L 266>
    var_0 = builtin_tid1d();
    // o = ray_origin[tid]                                                                    <L 267>
    var_1 = wp::address(var_ray_origin, var_0);
    var_3 = wp::load(var_1);
    var_2 = wp::copy(var_3);
    // d = ray_direction[tid]                                                                 <L 268>
    var_4 = wp::address(var_ray_direction, var_0);
    var_6 = wp::load(var_4);
    var_5 = wp::copy(var_6);
    // t = float(1.0e10)                                                                      <L 269>
    var_8 = wp::float(var_7);
    // for axis in range(3):                                                                  <L 270>
    // if d[axis] != 0.0:                                                                     <L 271>
    var_10 = wp::extract(var_5, var_9);
    var_12 = (var_10 != var_11);
    if (var_12) {
        // t = wp.min(t, wp.max((low[axis] - o[axis]) / d[axis], (high[axis] - o[axis]) / d[axis]))       <L 272>
        var_13 = wp::extract(var_low, var_9);
        var_14 = wp::extract(var_2, var_9);
        var_15 = wp::sub(var_13, var_14);
        var_16 = wp::extract(var_5, var_9);
        var_17 = wp::div(var_15, var_16);
        var_18 = wp::extract(var_high, var_9);
        var_19 = wp::extract(var_2, var_9);
        var_20 = wp::sub(var_18, var_19);
        var_21 = wp::extract(var_5, var_9);
        var_22 = wp::div(var_20, var_21);
        var_23 = wp::max(var_17, var_22);
        var_24 = wp::min(var_8, var_23);
    }
    var_25 = wp::where(var_12, var_24, var_8);
    // if d[axis] != 0.0:                                                                     <L 271>
    var_27 = wp::extract(var_5, var_26);
    var_29 = (var_27 != var_28);
    if (var_29) {
        // t = wp.min(t, wp.max((low[axis] - o[axis]) / d[axis], (high[axis] - o[axis]) / d[axis]))       <L 272>
        var_30 = wp::extract(var_low, var_26);
        var_31 = wp::extract(var_2, var_26);
        var_32 = wp::sub(var_30, var_31);
        var_33 = wp::extract(var_5, var_26);
        var_34 = wp::div(var_32, var_33);
        var_35 = wp::extract(var_high, var_26);
        var_36 = wp::extract(var_2, var_26);
        var_37 = wp::sub(var_35, var_36);
        var_38 = wp::extract(var_5, var_26);
        var_39 = wp::div(var_37, var_38);
        var_40 = wp::max(var_34, var_39);
        var_41 = wp::min(var_25, var_40);
    }
    var_42 = wp::where(var_29, var_41, var_25);
    // if d[axis] != 0.0:                                                                     <L 271>
    var_44 = wp::extract(var_5, var_43);
    var_46 = (var_44 != var_45);
    if (var_46) {
        // t = wp.min(t, wp.max((low[axis] - o[axis]) / d[axis], (high[axis] - o[axis]) / d[axis]))       <L 272>
        var_47 = wp::extract(var_low, var_43);
        var_48 = wp::extract(var_2, var_43);
        var_49 = wp::sub(var_47, var_48);
        var_50 = wp::extract(var_5, var_43);
        var_51 = wp::div(var_49, var_50);
        var_52 = wp::extract(var_high, var_43);
        var_53 = wp::extract(var_2, var_43);
        var_54 = wp::sub(var_52, var_53);
        var_55 = wp::extract(var_5, var_43);
        var_56 = wp::div(var_54, var_55);
        var_57 = wp::max(var_51, var_56);
        var_58 = wp::min(var_42, var_57);
    }
    var_59 = wp::where(var_46, var_58, var_42);
    // t_exit[tid] = t                                                                        <L 273>
    wp::array_store(var_t_exit, var_0, var_59);
    // kept = int(1)                                                                          <L 274>
    var_61 = wp::int(var_60);
    // if use_depth != 0:                                                                     <L 275>
    var_63 = (var_use_depth != var_62);
    if (var_63) {
        // kept = wp.where(t >= depth[tid], 1, 0)                                             <L 276>
        var_64 = wp::address(var_depth, var_0);
        var_66 = wp::load(var_64);
        var_65 = (var_59 >= var_66);
        var_69 = wp::where(var_65, var_67, var_68);
        // if kept == 1:                                                                      <L 277>
        var_71 = (var_69 == var_70);
        if (var_71) {
            // wp.atomic_max(max_depth, 0, depth[tid])                                        <L 278>
            var_73 = wp::address(var_depth, var_0);
            var_75 = wp::load(var_73);
            var_74 = wp::atomic_max(var_max_depth, var_72, var_75);
        }
    }
    var_76 = wp::where(var_63, var_69, var_61);
    // keep[tid] = kept                                                                       <L 279>
    wp::array_store(var_keep, var_0, var_76);
}



template <bool wp_linear_contiguous>
static WP_FORCEINLINE void bound_rays_4ad32ab6_cpu_forward_tasks(
    wp::launch_bounds_t<1> *dim,
    wp_args_bound_rays_4ad32ab6 *_wp_args)
{
    for (size_t task_index = 0; task_index < dim->size; ++task_index)
    {
        bound_rays_4ad32ab6_cpu_kernel_forward<wp_linear_contiguous>(*dim, task_index, _wp_args);
    }
}

static WP_FORCEINLINE void bound_rays_4ad32ab6_cpu_forward_dispatch(
    wp::launch_bounds_t<1> *dim,
    wp_args_bound_rays_4ad32ab6 *_wp_args)
{
    wp::tile_shared_storage_t tile_mem;
#if defined(WP_ENABLE_TILES_IN_STACK_MEMORY)
    wp::shared_tile_storage = &tile_mem;
#endif

    const bool wp_linear_contiguous = dim->coord_mult == 1 && ((_wp_args->ray_origin.strides[0] == (int)sizeof(wp::vec_t<3, wp::float32>)) & (_wp_args->ray_direction.strides[0] == (int)sizeof(wp::vec_t<3, wp::float32>)) & (_wp_args->depth.strides[0] == (int)sizeof(wp::float32)) & (_wp_args->t_exit.strides[0] == (int)sizeof(wp::float32)) & (_wp_args->keep.strides[0] == (int)sizeof(wp::int32)) & (_wp_args->max_depth.strides[0] == (int)sizeof(wp::float32)));
    if (wp_linear_contiguous)
        bound_rays_4ad32ab6_cpu_forward_tasks<true>(dim, _wp_args);
    else
        bound_rays_4ad32ab6_cpu_forward_tasks<false>(dim, _wp_args);
}

extern "C" {

// Python CPU entry points
WP_API void bound_rays_4ad32ab6_cpu_forward(
    wp::launch_bounds_t<1> *dim,
    wp_args_bound_rays_4ad32ab6 *_wp_args)
{
    bound_rays_4ad32ab6_cpu_forward_dispatch(dim, _wp_args);
}

} // extern C

struct wp_args_place_samples_718d174e {
    wp::int32 start;
    wp::array_t<wp::int32> seeds;
    wp::array_t<wp::int32> iteration;
    wp::int32 jitter;
    wp::int32 count;
    wp::int32 surface_count;
    wp::int32 use_depth;
    wp::array_t<wp::float32> depth;
    wp::array_t<wp::float32> t_exit;
    wp::array_t<wp::int32> keep;
    wp::array_t<wp::float32> max_depth;
    wp::array_t<wp::float32> z;
};


template <bool wp_linear_contiguous>
static void place_samples_718d174e_cpu_kernel_forward(
    wp::launch_bounds_t<1> dim,
    size_t task_index,
    wp_args_place_samples_718d174e *_wp_args)
{
    static constexpr bool wp_linear_tid = wp_linear_contiguous;
    wp_args_place_samples_718d174e wp_contiguous_args;
    if constexpr (wp_linear_contiguous)
    {
        wp_contiguous_args = *_wp_args;
        wp_contiguous_args.seeds.strides[0] = sizeof(wp::int32);
        wp_contiguous_args.iteration.strides[0] = sizeof(wp::int32);
        wp_contiguous_args.depth.strides[0] = sizeof(wp::float32);
        wp_contiguous_args.t_exit.strides[0] = sizeof(wp::float32);
        wp_contiguous_args.keep.strides[0] = sizeof(wp::int32);
        wp_contiguous_args.max_depth.strides[0] = sizeof(wp::float32);
        wp_contiguous_args.z.strides[0] = sizeof(wp::float32);
        _wp_args = &wp_contiguous_args;
    }
    //---------
    // argument vars
    wp::int32 var_start = _wp_args->start;
    wp::array_t<wp::int32> var_seeds = _wp_args->seeds;
    wp::array_t<wp::int32> var_iteration = _wp_args->iteration;
    wp::int32 var_jitter = _wp_args->jitter;
    wp::int32 var_count = _wp_args->count;
    wp::int32 var_surface_count = _wp_args->surface_count;
    wp::int32 var_use_depth = _wp_args->use_depth;
    wp::array_t<wp::float32> var_depth = _wp_args->depth;
    wp::array_t<wp::float32> var_t_exit = _wp_args->t_exit;
    wp::array_t<wp::int32> var_keep = _wp_args->keep;
    wp::array_t<wp::float32> var_max_depth = _wp_args->max_depth;
    wp::array_t<wp::float32> var_z = _wp_args->z;
    //---------
    // primal vars
    wp::int32 var_0;
    wp::int32 var_1;
    wp::int32* var_2;
    const wp::int32 var_3 = 0;
    bool var_4;
    wp::int32 var_5;
    const wp::float32 var_6 = 0.01;
    wp::float32 var_7;
    wp::float32* var_8;
    const wp::float32 var_9 = 0.01;
    wp::float32 var_10;
    wp::float32 var_11;
    const wp::float32 var_12 = 0.0;
    wp::float32 var_13;
    const wp::float32 var_14 = 0.0;
    wp::float32 var_15;
    const wp::int32 var_16 = 0;
    bool var_17;
    wp::float32* var_18;
    wp::float32 var_19;
    wp::float32 var_20;
    const wp::int32 var_21 = 0;
    wp::float32* var_22;
    wp::float32 var_23;
    wp::float32 var_24;
    const wp::float32 var_25 = 0.01;
    wp::float32 var_26;
    const wp::float32 var_27 = 0.0;
    const wp::float32 var_28 = 1.2;
    wp::float32 var_29;
    wp::float32 var_30;
    wp::float32 var_31;
    wp::float32 var_32;
    wp::float32 var_33;
    wp::float32 var_34;
    const wp::int32 var_35 = 0;
    wp::int32* var_36;
    wp::int32 var_37;
    wp::int32* var_38;
    const wp::int32 var_39 = 1540483477;
    wp::int32 var_40;
    wp::int32 var_41;
    wp::uint32 var_42;
    //---------
    // forward
    // def place_samples(                                                                     <L 348>
    // tid = start + wp.tid()                                                                 <L 362>
    var_0 = builtin_tid1d();
    var_1 = wp::add(var_start, var_0);
    // if keep[tid] == 0:                                                                     <L 363>
    var_2 = wp::address(var_keep, var_1);
    var_5 = wp::load(var_2);
    var_4 = (var_5 == var_3);
    if (var_4) {
        // return                                                                             <L 364>
        return;
    }
    // near = float(0.01)                                                                     <L 365>
    var_7 = wp::float(var_6);
    // far = t_exit[tid] + 0.01                                                               <L 366>
    var_8 = wp::address(var_t_exit, var_1);
    var_11 = wp::load(var_8);
    var_10 = wp::add(var_11, var_9);
    // largest = float(0.0)                                                                   <L 367>
    var_13 = wp::float(var_12);
    // measured = float(0.0)                                                                  <L 368>
    var_15 = wp::float(var_14);
    // if use_depth != 0:                                                                     <L 369>
    var_17 = (var_use_depth != var_16);
    if (var_17) {
        // measured = depth[tid]                                                              <L 370>
        var_18 = wp::address(var_depth, var_1);
        var_20 = wp::load(var_18);
        var_19 = wp::copy(var_20);
        // largest = max_depth[0]                                                             <L 371>
        var_22 = wp::address(var_max_depth, var_21);
        var_24 = wp::load(var_22);
        var_23 = wp::copy(var_24);
        // near = 0.01 * measured                                                             <L 372>
        var_26 = wp::mul(var_25, var_19);
        // far = wp.clamp(far, 0.0, 1.2 * largest)                                            <L 373>
        var_29 = wp::mul(var_28, var_23);
        var_30 = wp::clamp(var_10, var_27, var_29);
    }
    var_31 = wp::where(var_17, var_26, var_7);
    var_32 = wp::where(var_17, var_30, var_10);
    var_33 = wp::where(var_17, var_23, var_13);
    var_34 = wp::where(var_17, var_19, var_15);
    // state = wp.rand_init(seeds[iteration[0]] ^ 0x5BD1E995, tid)                            <L 374>
    var_36 = wp::address(var_iteration, var_35);
    var_37 = wp::load(var_36);
    var_38 = wp::address(var_seeds, var_37);
    var_41 = wp::load(var_38);
    var_40 = wp::bit_xor(var_41, var_39);
    var_42 = wp::rand_init(var_40, var_1);
    // place_ray(tid, count, surface_count, near, far, measured, largest, jitter, state, z)       <L 375>
    place_ray_0(var_1, var_count, var_surface_count, var_31, var_32, var_34, var_33, var_jitter, var_42, var_z);
}



template <bool wp_linear_contiguous>
static WP_FORCEINLINE void place_samples_718d174e_cpu_forward_tasks(
    wp::launch_bounds_t<1> *dim,
    wp_args_place_samples_718d174e *_wp_args)
{
    for (size_t task_index = 0; task_index < dim->size; ++task_index)
    {
        place_samples_718d174e_cpu_kernel_forward<wp_linear_contiguous>(*dim, task_index, _wp_args);
    }
}

static WP_FORCEINLINE void place_samples_718d174e_cpu_forward_dispatch(
    wp::launch_bounds_t<1> *dim,
    wp_args_place_samples_718d174e *_wp_args)
{
    wp::tile_shared_storage_t tile_mem;
#if defined(WP_ENABLE_TILES_IN_STACK_MEMORY)
    wp::shared_tile_storage = &tile_mem;
#endif

    const bool wp_linear_contiguous = dim->coord_mult == 1 && ((_wp_args->seeds.strides[0] == (int)sizeof(wp::int32)) & (_wp_args->iteration.strides[0] == (int)sizeof(wp::int32)) & (_wp_args->depth.strides[0] == (int)sizeof(wp::float32)) & (_wp_args->t_exit.strides[0] == (int)sizeof(wp::float32)) & (_wp_args->keep.strides[0] == (int)sizeof(wp::int32)) & (_wp_args->max_depth.strides[0] == (int)sizeof(wp::float32)) & (_wp_args->z.strides[0] == (int)sizeof(wp::float32)));
    if (wp_linear_contiguous)
        place_samples_718d174e_cpu_forward_tasks<true>(dim, _wp_args);
    else
        place_samples_718d174e_cpu_forward_tasks<false>(dim, _wp_args);
}

extern "C" {

// Python CPU entry points
WP_API void place_samples_718d174e_cpu_forward(
    wp::launch_bounds_t<1> *dim,
    wp_args_place_samples_718d174e *_wp_args)
{
    place_samples_718d174e_cpu_forward_dispatch(dim, _wp_args);
}

} // extern C

struct wp_args_collect_ray_gradients_a4d8356b {
    wp::int32 start;
    wp::int32 sample_count;
    wp::array_t<wp::int32> keep;
    wp::array_t<wp::float32> z;
    wp::array_t<wp::vec_t<3, wp::float32>> point_grad;
    wp::array_t<wp::vec_t<3, wp::float32>> origin_grad;
    wp::array_t<wp::vec_t<3, wp::float32>> direction_grad;
};


template <bool wp_linear_contiguous>
static void collect_ray_gradients_a4d8356b_cpu_kernel_forward(
    wp::launch_bounds_t<1> dim,
    size_t task_index,
    wp_args_collect_ray_gradients_a4d8356b *_wp_args)
{
    static constexpr bool wp_linear_tid = wp_linear_contiguous;
    wp_args_collect_ray_gradients_a4d8356b wp_contiguous_args;
    if constexpr (wp_linear_contiguous)
    {
        wp_contiguous_args = *_wp_args;
        wp_contiguous_args.keep.strides[0] = sizeof(wp::int32);
        wp_contiguous_args.z.strides[0] = sizeof(wp::float32);
        wp_contiguous_args.point_grad.strides[0] = sizeof(wp::vec_t<3, wp::float32>);
        wp_contiguous_args.origin_grad.strides[0] = sizeof(wp::vec_t<3, wp::float32>);
        wp_contiguous_args.direction_grad.strides[0] = sizeof(wp::vec_t<3, wp::float32>);
        _wp_args = &wp_contiguous_args;
    }
    //---------
    // argument vars
    wp::int32 var_start = _wp_args->start;
    wp::int32 var_sample_count = _wp_args->sample_count;
    wp::array_t<wp::int32> var_keep = _wp_args->keep;
    wp::array_t<wp::float32> var_z = _wp_args->z;
    wp::array_t<wp::vec_t<3, wp::float32>> var_point_grad = _wp_args->point_grad;
    wp::array_t<wp::vec_t<3, wp::float32>> var_origin_grad = _wp_args->origin_grad;
    wp::array_t<wp::vec_t<3, wp::float32>> var_direction_grad = _wp_args->direction_grad;
    //---------
    // primal vars
    wp::int32 var_0;
    wp::int32 var_1;
    wp::int32* var_2;
    const wp::int32 var_3 = 0;
    bool var_4;
    wp::int32 var_5;
    wp::vec_t<3, wp::float32> var_6;
    wp::vec_t<3, wp::float32> var_7;
    wp::range_t var_8;
    wp::int32 var_9;
    wp::int32 var_10;
    wp::int32 var_11;
    wp::vec_t<3, wp::float32>* var_12;
    wp::vec_t<3, wp::float32> var_13;
    wp::vec_t<3, wp::float32> var_14;
    wp::vec_t<3, wp::float32> var_15;
    wp::int32 var_16;
    wp::int32 var_17;
    wp::float32* var_18;
    wp::vec_t<3, wp::float32> var_19;
    wp::float32 var_20;
    wp::vec_t<3, wp::float32> var_21;
    wp::vec_t<3, wp::float32> var_22;
    wp::int32 var_23;
    wp::int32 var_24;
    wp::vec_t<3, wp::float32>* var_25;
    wp::vec_t<3, wp::float32> var_26;
    wp::vec_t<3, wp::float32> var_27;
    wp::vec_t<3, wp::float32>* var_28;
    wp::vec_t<3, wp::float32> var_29;
    wp::vec_t<3, wp::float32> var_30;
    //---------
    // forward
    // def collect_ray_gradients(                                                             <L 379>
    // tid = start + wp.tid()                                                                 <L 389>
    var_0 = builtin_tid1d();
    var_1 = wp::add(var_start, var_0);
    // if keep[tid] == 0:                                                                     <L 390>
    var_2 = wp::address(var_keep, var_1);
    var_5 = wp::load(var_2);
    var_4 = (var_5 == var_3);
    if (var_4) {
        // return                                                                             <L 391>
        return;
    }
    // do = wp.vec3()                                                                         <L 392>
    var_6 = wp::vec_t<3, wp::float32>();
    // dd = wp.vec3()                                                                         <L 393>
    var_7 = wp::vec_t<3, wp::float32>();
    // for n in range(sample_count):                                                          <L 394>
    var_8 = wp::range(var_sample_count);
    start_for_1:;
        if (iter_cmp(var_8) == 0) goto end_for_1;
        var_9 = wp::iter_next(var_8);
        // g = point_grad[tid * sample_count + n]                                             <L 395>
        var_10 = wp::mul(var_1, var_sample_count);
        var_11 = wp::add(var_10, var_9);
        var_12 = wp::address(var_point_grad, var_11);
        var_14 = wp::load(var_12);
        var_13 = wp::copy(var_14);
        // do += g                                                                            <L 396>
        var_15 = wp::add(var_6, var_13);
        // dd += z[tid * sample_count + n] * g                                                <L 397>
        var_16 = wp::mul(var_1, var_sample_count);
        var_17 = wp::add(var_16, var_9);
        var_18 = wp::address(var_z, var_17);
        var_20 = wp::load(var_18);
        var_19 = wp::mul(var_20, var_13);
        var_21 = wp::add(var_7, var_19);
        // point_grad[tid * sample_count + n] = wp.vec3()                                     <L 398>
        var_22 = wp::vec_t<3, wp::float32>();
        var_23 = wp::mul(var_1, var_sample_count);
        var_24 = wp::add(var_23, var_9);
        wp::array_store(var_point_grad, var_24, var_22);
        wp::assign(var_6, var_15);
        wp::assign(var_7, var_21);
        goto start_for_1;
    end_for_1:;
    // origin_grad[tid] = origin_grad[tid] + do                                               <L 399>
    var_25 = wp::address(var_origin_grad, var_1);
    var_27 = wp::load(var_25);
    var_26 = wp::add(var_27, var_6);
    wp::array_store(var_origin_grad, var_1, var_26);
    // direction_grad[tid] = direction_grad[tid] + dd                                         <L 400>
    var_28 = wp::address(var_direction_grad, var_1);
    var_30 = wp::load(var_28);
    var_29 = wp::add(var_30, var_7);
    wp::array_store(var_direction_grad, var_1, var_29);
}



template <bool wp_linear_contiguous>
static WP_FORCEINLINE void collect_ray_gradients_a4d8356b_cpu_forward_tasks(
    wp::launch_bounds_t<1> *dim,
    wp_args_collect_ray_gradients_a4d8356b *_wp_args)
{
    for (size_t task_index = 0; task_index < dim->size; ++task_index)
    {
        collect_ray_gradients_a4d8356b_cpu_kernel_forward<wp_linear_contiguous>(*dim, task_index, _wp_args);
    }
}

static WP_FORCEINLINE void collect_ray_gradients_a4d8356b_cpu_forward_dispatch(
    wp::launch_bounds_t<1> *dim,
    wp_args_collect_ray_gradients_a4d8356b *_wp_args)
{
    wp::tile_shared_storage_t tile_mem;
#if defined(WP_ENABLE_TILES_IN_STACK_MEMORY)
    wp::shared_tile_storage = &tile_mem;
#endif

    const bool wp_linear_contiguous = dim->coord_mult == 1 && ((_wp_args->keep.strides[0] == (int)sizeof(wp::int32)) & (_wp_args->z.strides[0] == (int)sizeof(wp::float32)) & (_wp_args->point_grad.strides[0] == (int)sizeof(wp::vec_t<3, wp::float32>)) & (_wp_args->origin_grad.strides[0] == (int)sizeof(wp::vec_t<3, wp::float32>)) & (_wp_args->direction_grad.strides[0] == (int)sizeof(wp::vec_t<3, wp::float32>)));
    if (wp_linear_contiguous)
        collect_ray_gradients_a4d8356b_cpu_forward_tasks<true>(dim, _wp_args);
    else
        collect_ray_gradients_a4d8356b_cpu_forward_tasks<false>(dim, _wp_args);
}

extern "C" {

// Python CPU entry points
WP_API void collect_ray_gradients_a4d8356b_cpu_forward(
    wp::launch_bounds_t<1> *dim,
    wp_args_collect_ray_gradients_a4d8356b *_wp_args)
{
    collect_ray_gradients_a4d8356b_cpu_forward_dispatch(dim, _wp_args);
}

} // extern C

struct wp_args_grid_pixels_acce3088 {
    wp::int32 first_row;
    wp::int32 width;
    wp::int32 stride;
    wp::vec_t<2, wp::float32> focal;
    wp::vec_t<2, wp::float32> center;
    wp::array_t<wp::int32> frame;
    wp::array_t<wp::vec_t<3, wp::float32>> direction_camera;
};


template <bool wp_linear_contiguous>
static void grid_pixels_acce3088_cpu_kernel_forward(
    wp::launch_bounds_t<1> dim,
    size_t task_index,
    wp_args_grid_pixels_acce3088 *_wp_args)
{
    static constexpr bool wp_linear_tid = wp_linear_contiguous;
    wp_args_grid_pixels_acce3088 wp_contiguous_args;
    if constexpr (wp_linear_contiguous)
    {
        wp_contiguous_args = *_wp_args;
        wp_contiguous_args.frame.strides[0] = sizeof(wp::int32);
        wp_contiguous_args.direction_camera.strides[0] = sizeof(wp::vec_t<3, wp::float32>);
        _wp_args = &wp_contiguous_args;
    }
    //---------
    // argument vars
    wp::int32 var_first_row = _wp_args->first_row;
    wp::int32 var_width = _wp_args->width;
    wp::int32 var_stride = _wp_args->stride;
    wp::vec_t<2, wp::float32> var_focal = _wp_args->focal;
    wp::vec_t<2, wp::float32> var_center = _wp_args->center;
    wp::array_t<wp::int32> var_frame = _wp_args->frame;
    wp::array_t<wp::vec_t<3, wp::float32>> var_direction_camera = _wp_args->direction_camera;
    //---------
    // primal vars
    wp::int32 var_0;
    wp::int32 var_1;
    wp::int32 var_2;
    wp::int32 var_3;
    wp::int32 var_4;
    wp::int32 var_5;
    const wp::int32 var_6 = 0;
    wp::vec_t<3, wp::float32> var_7;
    //---------
    // forward
    // def grid_pixels(                                                                       <L 221>
    // tid = wp.tid()                                                                         <L 231>
    var_0 = builtin_tid1d();
    // u = stride * (tid % width)                                                             <L 232>
    var_1 = wp::mod(var_0, var_width);
    var_2 = wp::mul(var_stride, var_1);
    // v = stride * (first_row + tid // width)                                                <L 233>
    var_3 = wp::floordiv(var_0, var_width);
    var_4 = wp::add(var_first_row, var_3);
    var_5 = wp::mul(var_stride, var_4);
    // frame[tid] = 0                                                                         <L 234>
    wp::array_store(var_frame, var_0, var_6);
    // direction_camera[tid] = pixel_direction(u, v, focal, center)                           <L 235>
    var_7 = pixel_direction_0(var_2, var_5, var_focal, var_center);
    wp::array_store(var_direction_camera, var_0, var_7);
}



template <bool wp_linear_contiguous>
static WP_FORCEINLINE void grid_pixels_acce3088_cpu_forward_tasks(
    wp::launch_bounds_t<1> *dim,
    wp_args_grid_pixels_acce3088 *_wp_args)
{
    for (size_t task_index = 0; task_index < dim->size; ++task_index)
    {
        grid_pixels_acce3088_cpu_kernel_forward<wp_linear_contiguous>(*dim, task_index, _wp_args);
    }
}

static WP_FORCEINLINE void grid_pixels_acce3088_cpu_forward_dispatch(
    wp::launch_bounds_t<1> *dim,
    wp_args_grid_pixels_acce3088 *_wp_args)
{
    wp::tile_shared_storage_t tile_mem;
#if defined(WP_ENABLE_TILES_IN_STACK_MEMORY)
    wp::shared_tile_storage = &tile_mem;
#endif

    const bool wp_linear_contiguous = dim->coord_mult == 1 && ((_wp_args->frame.strides[0] == (int)sizeof(wp::int32)) & (_wp_args->direction_camera.strides[0] == (int)sizeof(wp::vec_t<3, wp::float32>)));
    if (wp_linear_contiguous)
        grid_pixels_acce3088_cpu_forward_tasks<true>(dim, _wp_args);
    else
        grid_pixels_acce3088_cpu_forward_tasks<false>(dim, _wp_args);
}

extern "C" {

// Python CPU entry points
WP_API void grid_pixels_acce3088_cpu_forward(
    wp::launch_bounds_t<1> *dim,
    wp_args_grid_pixels_acce3088 *_wp_args)
{
    grid_pixels_acce3088_cpu_forward_dispatch(dim, _wp_args);
}

} // extern C

struct wp_args_draw_pixels_c8f8d032 {
    wp::array_t<wp::int32> seeds;
    wp::array_t<wp::int32> iteration;
    wp::int32 rays_per_frame;
    wp::array_t<wp::int32> window;
    wp::int32 edge_u;
    wp::int32 edge_v;
    wp::vec_t<2, wp::float32> focal;
    wp::vec_t<2, wp::float32> center;
    wp::array_t<wp::uint8> rgb_images;
    wp::array_t<wp::uint16> depth_images;
    wp::array_t<wp::float32> depth_scales;
    wp::float32 active_share;
    wp::vec_t<2, wp::int32> cells;
    wp::array_t<wp::float32> cumulative_error;
    wp::array_t<wp::int32> frame;
    wp::array_t<wp::vec_t<3, wp::float32>> direction_camera;
    wp::array_t<wp::float32> depth;
    wp::array_t<wp::vec_t<3, wp::float32>> rgb;
};


template <bool wp_linear_contiguous>
static void draw_pixels_c8f8d032_cpu_kernel_forward(
    wp::launch_bounds_t<1> dim,
    size_t task_index,
    wp_args_draw_pixels_c8f8d032 *_wp_args)
{
    static constexpr bool wp_linear_tid = wp_linear_contiguous;

    //---------
    // argument vars
    wp::array_t<wp::int32> var_seeds = _wp_args->seeds;
    wp::array_t<wp::int32> var_iteration = _wp_args->iteration;
    wp::int32 var_rays_per_frame = _wp_args->rays_per_frame;
    wp::array_t<wp::int32> var_window = _wp_args->window;
    wp::int32 var_edge_u = _wp_args->edge_u;
    wp::int32 var_edge_v = _wp_args->edge_v;
    wp::vec_t<2, wp::float32> var_focal = _wp_args->focal;
    wp::vec_t<2, wp::float32> var_center = _wp_args->center;
    wp::array_t<wp::uint8> var_rgb_images = _wp_args->rgb_images;
    wp::array_t<wp::uint16> var_depth_images = _wp_args->depth_images;
    wp::array_t<wp::float32> var_depth_scales = _wp_args->depth_scales;
    wp::float32 var_active_share = _wp_args->active_share;
    wp::vec_t<2, wp::int32> var_cells = _wp_args->cells;
    wp::array_t<wp::float32> var_cumulative_error = _wp_args->cumulative_error;
    wp::array_t<wp::int32> var_frame = _wp_args->frame;
    wp::array_t<wp::vec_t<3, wp::float32>> var_direction_camera = _wp_args->direction_camera;
    wp::array_t<wp::float32> var_depth = _wp_args->depth;
    wp::array_t<wp::vec_t<3, wp::float32>> var_rgb = _wp_args->rgb;
    //---------
    // primal vars
    wp::int32 var_0;
    wp::int32 var_1;
    wp::int32* var_2;
    wp::int32 var_3;
    wp::int32 var_4;
    wp::shape_t* var_5;
    const wp::int32 var_6 = 1;
    wp::int32 var_7;
    wp::shape_t var_8;
    wp::shape_t* var_9;
    const wp::int32 var_10 = 2;
    wp::int32 var_11;
    wp::shape_t var_12;
    const wp::int32 var_13 = 0;
    wp::int32* var_14;
    wp::int32 var_15;
    wp::int32* var_16;
    wp::uint32 var_17;
    wp::int32 var_18;
    wp::int32 var_19;
    wp::int32 var_20;
    wp::int32 var_21;
    wp::int32 var_22;
    bool var_23;
    const wp::float32 var_24 = 0.0;
    bool var_25;
    wp::float32 var_26;
    bool var_27;
    const wp::int32 var_28 = 0;
    wp::int32 var_29;
    const wp::int32 var_30 = 1;
    wp::int32 var_31;
    wp::int32 var_32;
    const wp::int32 var_33 = 1;
    wp::int32 var_34;
    wp::float32 var_35;
    wp::float32* var_36;
    wp::float32 var_37;
    wp::float32 var_38;
    const wp::int32 var_39 = 0;
    wp::int32 var_40;
    wp::int32 var_41;
    bool var_42;
    wp::int32 var_43;
    const wp::int32 var_44 = 2;
    wp::int32 var_45;
    wp::float32* var_46;
    bool var_47;
    wp::float32 var_48;
    wp::int32 var_49;
    const wp::int32 var_50 = 1;
    wp::int32 var_51;
    wp::int32 var_52;
    wp::int32 var_53;
    wp::float32 var_54;
    wp::float32 var_55;
    wp::vec_t<2, wp::int32> var_56;
    const wp::int32 var_57 = 0;
    wp::int32 var_58;
    const wp::int32 var_59 = 1;
    wp::int32 var_60;
    wp::int32 var_61;
    wp::int32 var_62;
    wp::vec_t<3, wp::float32> var_63;
    wp::uint16* var_64;
    wp::float32 var_65;
    wp::uint16 var_66;
    wp::float32* var_67;
    wp::float32 var_68;
    wp::float32 var_69;
    const wp::int32 var_70 = 0;
    wp::uint8* var_71;
    wp::float32 var_72;
    wp::uint8 var_73;
    const wp::int32 var_74 = 1;
    wp::uint8* var_75;
    wp::float32 var_76;
    wp::uint8 var_77;
    const wp::int32 var_78 = 2;
    wp::uint8* var_79;
    wp::float32 var_80;
    wp::uint8 var_81;
    wp::vec_t<3, wp::float32> var_82;
    const wp::float32 var_83 = 255.0;
    wp::vec_t<3, wp::float32> var_84;
    //---------
    // forward
    // def draw_pixels(                                                                       <L 48>
    // tid = wp.tid()                                                                         <L 74>
    var_0 = builtin_tid1d();
    // f = tid // rays_per_frame                                                              <L 75>
    var_1 = wp::floordiv(var_0, var_rays_per_frame);
    // slot = window[f]                                                                       <L 76>
    var_2 = wp::address(var_window, var_1);
    var_4 = wp::load(var_2);
    var_3 = wp::copy(var_4);
    // height = depth_images.shape[1]                                                         <L 77>
    var_5 = &(var_depth_images.shape);
    var_8 = wp::load(var_5);
    var_7 = wp::extract(var_8, var_6);
    // width = depth_images.shape[2]                                                          <L 78>
    var_9 = &(var_depth_images.shape);
    var_12 = wp::load(var_9);
    var_11 = wp::extract(var_12, var_10);
    // state = wp.rand_init(seeds[iteration[0]], tid)                                         <L 79>
    var_14 = wp::address(var_iteration, var_13);
    var_15 = wp::load(var_14);
    var_16 = wp::address(var_seeds, var_15);
    var_18 = wp::load(var_16);
    var_17 = wp::rand_init(var_18, var_0);
    // u = wp.randi(state, edge_u, width - edge_u)                                            <L 80>
    var_19 = wp::sub(var_11, var_edge_u);
    var_20 = wp::randi(var_17, var_edge_u, var_19);
    // v = wp.randi(state, edge_v, height - edge_v)                                           <L 81>
    var_21 = wp::sub(var_7, var_edge_v);
    var_22 = wp::randi(var_17, var_edge_v, var_21);
    // if active_share > 0.0 and wp.randf(state) < active_share:                              <L 82>
    var_25 = (var_active_share > var_24);
    var_23 = var_25;
    if (var_23) {
        var_26 = wp::randf(var_17);
        var_27 = (var_26 < var_active_share);
        var_23 = var_23 && var_27;
    }
    if (var_23) {
        // last = cells[0] * cells[1] - 1                                                     <L 83>
        var_29 = wp::extract(var_cells, var_28);
        var_31 = wp::extract(var_cells, var_30);
        var_32 = wp::mul(var_29, var_31);
        var_34 = wp::sub(var_32, var_33);
        // wanted = wp.randf(state) * cumulative_error[f, last]                               <L 84>
        var_35 = wp::randf(var_17);
        var_36 = wp::address(var_cumulative_error, var_1, var_34);
        var_38 = wp::load(var_36);
        var_37 = wp::mul(var_35, var_38);
        // low = int(0)                                                                       <L 85>
        var_40 = wp::int(var_39);
        // high = int(last)                                                                   <L 86>
        var_41 = wp::int(var_34);
        // while low < high:                                                                  <L 87>
    start_while_0:;
        var_42 = (var_40 < var_41);
    if ((var_42) == false) goto end_while_0;
            // middle = (low + high) // 2                                                     <L 88>
            var_43 = wp::add(var_40, var_41);
            var_45 = wp::floordiv(var_43, var_44);
            // if cumulative_error[f, middle] > wanted:                                       <L 89>
            var_46 = wp::address(var_cumulative_error, var_1, var_45);
            var_48 = wp::load(var_46);
            var_47 = (var_48 > var_37);
            if (var_47) {
                // high = middle                                                              <L 90>
                var_49 = wp::copy(var_45);
            }
            if (!var_47) {
                // low = middle + 1                                                           <L 92>
                var_51 = wp::add(var_45, var_50);
            }
            var_52 = wp::where(var_47, var_40, var_51);
            var_53 = wp::where(var_47, var_49, var_41);
            wp::assign(var_40, var_52);
            wp::assign(var_41, var_53);
    goto start_while_0;
    end_while_0:;
        // x = wp.randf(state)                                                                <L 93>
        var_54 = wp::randf(var_17);
        // y = wp.randf(state)                                                                <L 94>
        var_55 = wp::randf(var_17);
        // pixel = cell_pixel(low, cells, width, height, x, y)                                <L 95>
        var_56 = cell_pixel_0(var_40, var_cells, var_11, var_7, var_54, var_55);
        // u = pixel[0]                                                                       <L 96>
        var_58 = wp::extract(var_56, var_57);
        // v = pixel[1]                                                                       <L 97>
        var_60 = wp::extract(var_56, var_59);
    }
    var_61 = wp::where(var_23, var_58, var_20);
    var_62 = wp::where(var_23, var_60, var_22);
    // frame[tid] = f                                                                         <L 98>
    wp::array_store(var_frame, var_0, var_1);
    // direction_camera[tid] = pixel_direction(u, v, focal, center)                           <L 99>
    var_63 = pixel_direction_0(var_61, var_62, var_focal, var_center);
    wp::array_store(var_direction_camera, var_0, var_63);
    // depth[tid] = float(depth_images[slot, v, u]) * depth_scales[slot]                      <L 100>
    var_64 = wp::address(var_depth_images, var_3, var_62, var_61);
    var_66 = wp::load(var_64);
    var_65 = wp::float(var_66);
    var_67 = wp::address(var_depth_scales, var_3);
    var_69 = wp::load(var_67);
    var_68 = wp::mul(var_65, var_69);
    wp::array_store(var_depth, var_0, var_68);
    // rgb[tid] = (                                                                           <L 101>
    // wp.vec3(float(rgb_images[slot, v, u, 0]), float(rgb_images[slot, v, u, 1]), float(rgb_images[slot, v, u, 2]))       <L 102>
    var_71 = wp::address(var_rgb_images, var_3, var_62, var_61, var_70);
    var_73 = wp::load(var_71);
    var_72 = wp::float(var_73);
    var_75 = wp::address(var_rgb_images, var_3, var_62, var_61, var_74);
    var_77 = wp::load(var_75);
    var_76 = wp::float(var_77);
    var_79 = wp::address(var_rgb_images, var_3, var_62, var_61, var_78);
    var_81 = wp::load(var_79);
    var_80 = wp::float(var_81);
    var_82 = wp::vec_t<3, wp::float32>(var_72, var_76, var_80);
    // / 255.0                                                                                <L 103>
    var_84 = wp::div(var_82, var_83);
    // rgb[tid] = (                                                                           <L 101>
    wp::array_store(var_rgb, var_0, var_84);
}



template <bool wp_linear_contiguous>
static WP_FORCEINLINE void draw_pixels_c8f8d032_cpu_forward_tasks(
    wp::launch_bounds_t<1> *dim,
    wp_args_draw_pixels_c8f8d032 *_wp_args)
{
    for (size_t task_index = 0; task_index < dim->size; ++task_index)
    {
        draw_pixels_c8f8d032_cpu_kernel_forward<wp_linear_contiguous>(*dim, task_index, _wp_args);
    }
}

static WP_FORCEINLINE void draw_pixels_c8f8d032_cpu_forward_dispatch(
    wp::launch_bounds_t<1> *dim,
    wp_args_draw_pixels_c8f8d032 *_wp_args)
{
    wp::tile_shared_storage_t tile_mem;
#if defined(WP_ENABLE_TILES_IN_STACK_MEMORY)
    wp::shared_tile_storage = &tile_mem;
#endif

    draw_pixels_c8f8d032_cpu_forward_tasks<false>(dim, _wp_args);
}

extern "C" {

// Python CPU entry points
WP_API void draw_pixels_c8f8d032_cpu_forward(
    wp::launch_bounds_t<1> *dim,
    wp_args_draw_pixels_c8f8d032 *_wp_args)
{
    draw_pixels_c8f8d032_cpu_forward_dispatch(dim, _wp_args);
}

} // extern C

struct wp_args_probe_pixels_cab31d3b {
    wp::array_t<wp::int32> seeds;
    wp::array_t<wp::int32> iteration;
    wp::array_t<wp::int32> window;
    wp::vec_t<2, wp::int32> cells;
    wp::vec_t<2, wp::float32> focal;
    wp::vec_t<2, wp::float32> center;
    wp::array_t<wp::uint16> depth_images;
    wp::array_t<wp::float32> depth_scales;
    wp::array_t<wp::int32> frame;
    wp::array_t<wp::vec_t<3, wp::float32>> direction_camera;
    wp::array_t<wp::float32> depth;
};


template <bool wp_linear_contiguous>
static void probe_pixels_cab31d3b_cpu_kernel_forward(
    wp::launch_bounds_t<1> dim,
    size_t task_index,
    wp_args_probe_pixels_cab31d3b *_wp_args)
{
    static constexpr bool wp_linear_tid = wp_linear_contiguous;

    //---------
    // argument vars
    wp::array_t<wp::int32> var_seeds = _wp_args->seeds;
    wp::array_t<wp::int32> var_iteration = _wp_args->iteration;
    wp::array_t<wp::int32> var_window = _wp_args->window;
    wp::vec_t<2, wp::int32> var_cells = _wp_args->cells;
    wp::vec_t<2, wp::float32> var_focal = _wp_args->focal;
    wp::vec_t<2, wp::float32> var_center = _wp_args->center;
    wp::array_t<wp::uint16> var_depth_images = _wp_args->depth_images;
    wp::array_t<wp::float32> var_depth_scales = _wp_args->depth_scales;
    wp::array_t<wp::int32> var_frame = _wp_args->frame;
    wp::array_t<wp::vec_t<3, wp::float32>> var_direction_camera = _wp_args->direction_camera;
    wp::array_t<wp::float32> var_depth = _wp_args->depth;
    //---------
    // primal vars
    wp::int32 var_0;
    const wp::int32 var_1 = 0;
    wp::int32 var_2;
    const wp::int32 var_3 = 1;
    wp::int32 var_4;
    wp::int32 var_5;
    wp::int32 var_6;
    wp::int32* var_7;
    wp::int32 var_8;
    wp::int32 var_9;
    const wp::int32 var_10 = 0;
    wp::int32* var_11;
    wp::int32 var_12;
    wp::int32* var_13;
    wp::uint32 var_14;
    wp::int32 var_15;
    wp::float32 var_16;
    wp::float32 var_17;
    const wp::int32 var_18 = 0;
    wp::int32 var_19;
    const wp::int32 var_20 = 1;
    wp::int32 var_21;
    wp::int32 var_22;
    wp::int32 var_23;
    wp::shape_t* var_24;
    const wp::int32 var_25 = 2;
    wp::int32 var_26;
    wp::shape_t var_27;
    wp::shape_t* var_28;
    const wp::int32 var_29 = 1;
    wp::int32 var_30;
    wp::shape_t var_31;
    wp::vec_t<2, wp::int32> var_32;
    const wp::int32 var_33 = 0;
    wp::int32 var_34;
    const wp::int32 var_35 = 1;
    wp::int32 var_36;
    wp::vec_t<3, wp::float32> var_37;
    const wp::int32 var_38 = 1;
    wp::int32 var_39;
    const wp::int32 var_40 = 0;
    wp::int32 var_41;
    wp::uint16* var_42;
    wp::float32 var_43;
    wp::uint16 var_44;
    wp::float32* var_45;
    wp::float32 var_46;
    wp::float32 var_47;
    //---------
    // forward
    // def probe_pixels(                                                                      <L 108>
    // tid = wp.tid()                                                                         <L 122>
    var_0 = builtin_tid1d();
    // f = tid // (cells[0] * cells[1])                                                       <L 123>
    var_2 = wp::extract(var_cells, var_1);
    var_4 = wp::extract(var_cells, var_3);
    var_5 = wp::mul(var_2, var_4);
    var_6 = wp::floordiv(var_0, var_5);
    // slot = window[f]                                                                       <L 124>
    var_7 = wp::address(var_window, var_6);
    var_9 = wp::load(var_7);
    var_8 = wp::copy(var_9);
    // state = wp.rand_init(seeds[iteration[0]], tid)                                         <L 125>
    var_11 = wp::address(var_iteration, var_10);
    var_12 = wp::load(var_11);
    var_13 = wp::address(var_seeds, var_12);
    var_15 = wp::load(var_13);
    var_14 = wp::rand_init(var_15, var_0);
    // x = wp.randf(state)                                                                    <L 126>
    var_16 = wp::randf(var_14);
    // y = wp.randf(state)                                                                    <L 127>
    var_17 = wp::randf(var_14);
    // pixel = cell_pixel(tid % (cells[0] * cells[1]), cells, depth_images.shape[2], depth_images.shape[1], x, y)       <L 128>
    var_19 = wp::extract(var_cells, var_18);
    var_21 = wp::extract(var_cells, var_20);
    var_22 = wp::mul(var_19, var_21);
    var_23 = wp::mod(var_0, var_22);
    var_24 = &(var_depth_images.shape);
    var_27 = wp::load(var_24);
    var_26 = wp::extract(var_27, var_25);
    var_28 = &(var_depth_images.shape);
    var_31 = wp::load(var_28);
    var_30 = wp::extract(var_31, var_29);
    var_32 = cell_pixel_0(var_23, var_cells, var_26, var_30, var_16, var_17);
    // frame[tid] = f                                                                         <L 129>
    wp::array_store(var_frame, var_0, var_6);
    // direction_camera[tid] = pixel_direction(pixel[0], pixel[1], focal, center)             <L 130>
    var_34 = wp::extract(var_32, var_33);
    var_36 = wp::extract(var_32, var_35);
    var_37 = pixel_direction_0(var_34, var_36, var_focal, var_center);
    wp::array_store(var_direction_camera, var_0, var_37);
    // depth[tid] = float(depth_images[slot, pixel[1], pixel[0]]) * depth_scales[slot]        <L 131>
    var_39 = wp::extract(var_32, var_38);
    var_41 = wp::extract(var_32, var_40);
    var_42 = wp::address(var_depth_images, var_8, var_39, var_41);
    var_44 = wp::load(var_42);
    var_43 = wp::float(var_44);
    var_45 = wp::address(var_depth_scales, var_8);
    var_47 = wp::load(var_45);
    var_46 = wp::mul(var_43, var_47);
    wp::array_store(var_depth, var_0, var_46);
}



template <bool wp_linear_contiguous>
static WP_FORCEINLINE void probe_pixels_cab31d3b_cpu_forward_tasks(
    wp::launch_bounds_t<1> *dim,
    wp_args_probe_pixels_cab31d3b *_wp_args)
{
    for (size_t task_index = 0; task_index < dim->size; ++task_index)
    {
        probe_pixels_cab31d3b_cpu_kernel_forward<wp_linear_contiguous>(*dim, task_index, _wp_args);
    }
}

static WP_FORCEINLINE void probe_pixels_cab31d3b_cpu_forward_dispatch(
    wp::launch_bounds_t<1> *dim,
    wp_args_probe_pixels_cab31d3b *_wp_args)
{
    wp::tile_shared_storage_t tile_mem;
#if defined(WP_ENABLE_TILES_IN_STACK_MEMORY)
    wp::shared_tile_storage = &tile_mem;
#endif

    probe_pixels_cab31d3b_cpu_forward_tasks<false>(dim, _wp_args);
}

extern "C" {

// Python CPU entry points
WP_API void probe_pixels_cab31d3b_cpu_forward(
    wp::launch_bounds_t<1> *dim,
    wp_args_probe_pixels_cab31d3b *_wp_args)
{
    probe_pixels_cab31d3b_cpu_forward_dispatch(dim, _wp_args);
}

} // extern C

struct wp_args_cast_rays_cd516643 {
    wp::array_t<wp::float32> poses;
    wp::array_t<wp::int32> frame;
    wp::array_t<wp::vec_t<3, wp::float32>> direction_camera;
    wp::array_t<wp::vec_t<3, wp::float32>> ray_origin;
    wp::array_t<wp::vec_t<3, wp::float32>> ray_direction;
};


template <bool wp_linear_contiguous>
static void cast_rays_cd516643_cpu_kernel_forward(
    wp::launch_bounds_t<1> dim,
    size_t task_index,
    wp_args_cast_rays_cd516643 *_wp_args)
{
    static constexpr bool wp_linear_tid = wp_linear_contiguous;

    //---------
    // argument vars
    wp::array_t<wp::float32> var_poses = _wp_args->poses;
    wp::array_t<wp::int32> var_frame = _wp_args->frame;
    wp::array_t<wp::vec_t<3, wp::float32>> var_direction_camera = _wp_args->direction_camera;
    wp::array_t<wp::vec_t<3, wp::float32>> var_ray_origin = _wp_args->ray_origin;
    wp::array_t<wp::vec_t<3, wp::float32>> var_ray_direction = _wp_args->ray_direction;
    //---------
    // primal vars
    wp::int32 var_0;
    wp::int32* var_1;
    wp::int32 var_2;
    wp::int32 var_3;
    const wp::int32 var_4 = 0;
    wp::float32* var_5;
    const wp::int32 var_6 = 1;
    wp::float32* var_7;
    const wp::int32 var_8 = 2;
    wp::float32* var_9;
    const wp::int32 var_10 = 3;
    wp::float32* var_11;
    wp::mat_t<3, 3, wp::float32> var_12;
    wp::float32 var_13;
    wp::float32 var_14;
    wp::float32 var_15;
    wp::float32 var_16;
    wp::vec_t<3, wp::float32>* var_17;
    wp::vec_t<3, wp::float32> var_18;
    wp::vec_t<3, wp::float32> var_19;
    const wp::int32 var_20 = 4;
    wp::float32* var_21;
    const wp::int32 var_22 = 5;
    wp::float32* var_23;
    const wp::int32 var_24 = 6;
    wp::float32* var_25;
    wp::vec_t<3, wp::float32> var_26;
    wp::float32 var_27;
    wp::float32 var_28;
    wp::float32 var_29;
    //---------
    // forward
    // def cast_rays(                                                                         <L 239>
    // tid = wp.tid()                                                                         <L 246>
    var_0 = builtin_tid1d();
    // f = frame[tid]                                                                         <L 247>
    var_1 = wp::address(var_frame, var_0);
    var_3 = wp::load(var_1);
    var_2 = wp::copy(var_3);
    // R = rotation_from_quaternion(poses[f, 0], poses[f, 1], poses[f, 2], poses[f, 3])       <L 248>
    var_5 = wp::address(var_poses, var_2, var_4);
    var_7 = wp::address(var_poses, var_2, var_6);
    var_9 = wp::address(var_poses, var_2, var_8);
    var_11 = wp::address(var_poses, var_2, var_10);
    var_13 = wp::load(var_5);
    var_14 = wp::load(var_7);
    var_15 = wp::load(var_9);
    var_16 = wp::load(var_11);
    var_12 = rotation_from_quaternion_0(var_13, var_14, var_15, var_16);
    // ray_direction[tid] = R * direction_camera[tid]                                         <L 249>
    var_17 = wp::address(var_direction_camera, var_0);
    var_19 = wp::load(var_17);
    var_18 = wp::mul(var_12, var_19);
    wp::array_store(var_ray_direction, var_0, var_18);
    // ray_origin[tid] = wp.vec3(poses[f, 4], poses[f, 5], poses[f, 6])                       <L 250>
    var_21 = wp::address(var_poses, var_2, var_20);
    var_23 = wp::address(var_poses, var_2, var_22);
    var_25 = wp::address(var_poses, var_2, var_24);
    var_27 = wp::load(var_21);
    var_28 = wp::load(var_23);
    var_29 = wp::load(var_25);
    var_26 = wp::vec_t<3, wp::float32>(var_27, var_28, var_29);
    wp::array_store(var_ray_origin, var_0, var_26);
}



template <bool wp_linear_contiguous>
static void cast_rays_cd516643_cpu_kernel_backward(
    wp::launch_bounds_t<1> dim,
    size_t task_index,
    wp_args_cast_rays_cd516643 *_wp_args,
    wp_args_cast_rays_cd516643 *_wp_adj_args)
{
    static constexpr bool wp_linear_tid = wp_linear_contiguous;

    //---------
    // argument vars
    wp::array_t<wp::float32> var_poses = _wp_args->poses;
    wp::array_t<wp::int32> var_frame = _wp_args->frame;
    wp::array_t<wp::vec_t<3, wp::float32>> var_direction_camera = _wp_args->direction_camera;
    wp::array_t<wp::vec_t<3, wp::float32>> var_ray_origin = _wp_args->ray_origin;
    wp::array_t<wp::vec_t<3, wp::float32>> var_ray_direction = _wp_args->ray_direction;
    wp::array_t<wp::float32> adj_poses = _wp_adj_args->poses;
    wp::array_t<wp::int32> adj_frame = _wp_adj_args->frame;
    wp::array_t<wp::vec_t<3, wp::float32>> adj_direction_camera = _wp_adj_args->direction_camera;
    wp::array_t<wp::vec_t<3, wp::float32>> adj_ray_origin = _wp_adj_args->ray_origin;
    wp::array_t<wp::vec_t<3, wp::float32>> adj_ray_direction = _wp_adj_args->ray_direction;
    //---------
    // primal vars
    wp::int32 var_0;
    wp::int32* var_1;
    wp::int32 var_2;
    wp::int32 var_3;
    const wp::int32 var_4 = 0;
    wp::float32* var_5;
    const wp::int32 var_6 = 1;
    wp::float32* var_7;
    const wp::int32 var_8 = 2;
    wp::float32* var_9;
    const wp::int32 var_10 = 3;
    wp::float32* var_11;
    wp::mat_t<3, 3, wp::float32> var_12;
    wp::float32 var_13;
    wp::float32 var_14;
    wp::float32 var_15;
    wp::float32 var_16;
    wp::vec_t<3, wp::float32>* var_17;
    wp::vec_t<3, wp::float32> var_18;
    wp::vec_t<3, wp::float32> var_19;
    const wp::int32 var_20 = 4;
    wp::float32* var_21;
    const wp::int32 var_22 = 5;
    wp::float32* var_23;
    const wp::int32 var_24 = 6;
    wp::float32* var_25;
    wp::vec_t<3, wp::float32> var_26;
    wp::float32 var_27;
    wp::float32 var_28;
    wp::float32 var_29;
    //---------
    // dual vars
    wp::int32 adj_0 = {};
    wp::int32 adj_1 = {};
    wp::int32 adj_2 = {};
    wp::int32 adj_3 = {};
    wp::int32 adj_4 = {};
    wp::float32 adj_5 = {};
    wp::int32 adj_6 = {};
    wp::float32 adj_7 = {};
    wp::int32 adj_8 = {};
    wp::float32 adj_9 = {};
    wp::int32 adj_10 = {};
    wp::float32 adj_11 = {};
    wp::mat_t<3, 3, wp::float32> adj_12 = {};
    wp::float32 adj_13 = {};
    wp::float32 adj_14 = {};
    wp::float32 adj_15 = {};
    wp::float32 adj_16 = {};
    wp::vec_t<3, wp::float32> adj_17 = {};
    wp::vec_t<3, wp::float32> adj_18 = {};
    wp::vec_t<3, wp::float32> adj_19 = {};
    wp::int32 adj_20 = {};
    wp::float32 adj_21 = {};
    wp::int32 adj_22 = {};
    wp::float32 adj_23 = {};
    wp::int32 adj_24 = {};
    wp::float32 adj_25 = {};
    wp::vec_t<3, wp::float32> adj_26 = {};
    wp::float32 adj_27 = {};
    wp::float32 adj_28 = {};
    wp::float32 adj_29 = {};
    //---------
    // forward
    // def cast_rays(                                                                         <L 239>
    // tid = wp.tid()                                                                         <L 246>
    var_0 = builtin_tid1d();
    // f = frame[tid]                                                                         <L 247>
    var_1 = wp::address(var_frame, var_0);
    var_3 = wp::load(var_1);
    var_2 = wp::copy(var_3);
    // R = rotation_from_quaternion(poses[f, 0], poses[f, 1], poses[f, 2], poses[f, 3])       <L 248>
    var_5 = wp::address(var_poses, var_2, var_4);
    var_7 = wp::address(var_poses, var_2, var_6);
    var_9 = wp::address(var_poses, var_2, var_8);
    var_11 = wp::address(var_poses, var_2, var_10);
    var_13 = wp::load(var_5);
    var_14 = wp::load(var_7);
    var_15 = wp::load(var_9);
    var_16 = wp::load(var_11);
    var_12 = rotation_from_quaternion_0(var_13, var_14, var_15, var_16);
    // ray_direction[tid] = R * direction_camera[tid]                                         <L 249>
    var_17 = wp::address(var_direction_camera, var_0);
    var_19 = wp::load(var_17);
    var_18 = wp::mul(var_12, var_19);
    // wp::array_store(var_ray_direction, var_0, var_18);
    // ray_origin[tid] = wp.vec3(poses[f, 4], poses[f, 5], poses[f, 6])                       <L 250>
    var_21 = wp::address(var_poses, var_2, var_20);
    var_23 = wp::address(var_poses, var_2, var_22);
    var_25 = wp::address(var_poses, var_2, var_24);
    var_27 = wp::load(var_21);
    var_28 = wp::load(var_23);
    var_29 = wp::load(var_25);
    var_26 = wp::vec_t<3, wp::float32>(var_27, var_28, var_29);
    // wp::array_store(var_ray_origin, var_0, var_26);
    //---------
    // reverse
    wp::adj_array_store(var_ray_origin, var_0, var_26, adj_ray_origin, adj_0, adj_26);
    wp::adj_vec_t(var_27, var_28, var_29, adj_21, adj_23, adj_25, adj_26);
    wp::adj_address(var_poses, var_2, var_24, adj_poses, adj_2, adj_24, adj_25);
    wp::adj_address(var_poses, var_2, var_22, adj_poses, adj_2, adj_22, adj_23);
    wp::adj_address(var_poses, var_2, var_20, adj_poses, adj_2, adj_20, adj_21);
    // adj: ray_origin[tid] = wp.vec3(poses[f, 4], poses[f, 5], poses[f, 6])                  <L 250>
    wp::adj_array_store(var_ray_direction, var_0, var_18, adj_ray_direction, adj_0, adj_18);
    wp::adj_mul(var_12, var_19, adj_12, adj_17, adj_18);
    wp::adj_address(var_direction_camera, var_0, adj_direction_camera, adj_0, adj_17);
    // adj: ray_direction[tid] = R * direction_camera[tid]                                    <L 249>
    adj_rotation_from_quaternion_0(var_13, var_14, var_15, var_16, adj_5, adj_7, adj_9, adj_11, adj_12);
    wp::adj_address(var_poses, var_2, var_10, adj_poses, adj_2, adj_10, adj_11);
    wp::adj_address(var_poses, var_2, var_8, adj_poses, adj_2, adj_8, adj_9);
    wp::adj_address(var_poses, var_2, var_6, adj_poses, adj_2, adj_6, adj_7);
    wp::adj_address(var_poses, var_2, var_4, adj_poses, adj_2, adj_4, adj_5);
    // adj: R = rotation_from_quaternion(poses[f, 0], poses[f, 1], poses[f, 2], poses[f, 3])  <L 248>
    wp::adj_copy(var_3, adj_1, adj_2);
    wp::adj_address(var_frame, var_0, adj_frame, adj_0, adj_1);
    // adj: f = frame[tid]                                                                    <L 247>
    // adj: tid = wp.tid()                                                                    <L 246>
    // adj: def cast_rays(                                                                    <L 239>
    return;
}



template <bool wp_linear_contiguous>
static WP_FORCEINLINE void cast_rays_cd516643_cpu_forward_tasks(
    wp::launch_bounds_t<1> *dim,
    wp_args_cast_rays_cd516643 *_wp_args)
{
    for (size_t task_index = 0; task_index < dim->size; ++task_index)
    {
        cast_rays_cd516643_cpu_kernel_forward<wp_linear_contiguous>(*dim, task_index, _wp_args);
    }
}

static WP_FORCEINLINE void cast_rays_cd516643_cpu_forward_dispatch(
    wp::launch_bounds_t<1> *dim,
    wp_args_cast_rays_cd516643 *_wp_args)
{
    wp::tile_shared_storage_t tile_mem;
#if defined(WP_ENABLE_TILES_IN_STACK_MEMORY)
    wp::shared_tile_storage = &tile_mem;
#endif

    cast_rays_cd516643_cpu_forward_tasks<false>(dim, _wp_args);
}

extern "C" {

// Python CPU entry points
WP_API void cast_rays_cd516643_cpu_forward(
    wp::launch_bounds_t<1> *dim,
    wp_args_cast_rays_cd516643 *_wp_args)
{
    cast_rays_cd516643_cpu_forward_dispatch(dim, _wp_args);
}

} // extern C



template <bool wp_linear_contiguous>
static WP_FORCEINLINE void cast_rays_cd516643_cpu_backward_tasks(
    wp::launch_bounds_t<1> *dim,
    wp_args_cast_rays_cd516643 *_wp_args,
    wp_args_cast_rays_cd516643 *_wp_adj_args)
{
    for (size_t task_index = 0; task_index < dim->size; ++task_index)
    {
        cast_rays_cd516643_cpu_kernel_backward<wp_linear_contiguous>(
            *dim, task_index, _wp_args, _wp_adj_args);
    }
}

static WP_FORCEINLINE void cast_rays_cd516643_cpu_backward_dispatch(
    wp::launch_bounds_t<1> *dim,
    wp_args_cast_rays_cd516643 *_wp_args,
    wp_args_cast_rays_cd516643 *_wp_adj_args)
{
    wp::tile_shared_storage_t tile_mem;
#if defined(WP_ENABLE_TILES_IN_STACK_MEMORY)
    wp::shared_tile_storage = &tile_mem;
#endif

    cast_rays_cd516643_cpu_backward_tasks<false>(dim, _wp_args, _wp_adj_args);
}

extern "C" {

WP_API void cast_rays_cd516643_cpu_backward(
    wp::launch_bounds_t<1> *dim,
    wp_args_cast_rays_cd516643 *_wp_args,
    wp_args_cast_rays_cd516643 *_wp_adj_args)
{
    cast_rays_cd516643_cpu_backward_dispatch(dim, _wp_args, _wp_adj_args);
}

} // extern C

struct wp_args_drop_contradicted_ff9c363c {
    wp::int32 current;
    wp::float32 margin;
    wp::float32 step;
    wp::mat_t<4, 4, wp::float32> T_camera_world;
    wp::vec_t<2, wp::float32> focal;
    wp::vec_t<2, wp::float32> center;
    wp::array_t<wp::uint16> depth_images;
    wp::array_t<wp::float32> depth_scales;
    wp::array_t<wp::int32> frame;
    wp::array_t<wp::vec_t<3, wp::float32>> origin;
    wp::array_t<wp::vec_t<3, wp::float32>> direction;
    wp::array_t<wp::float32> depth;
    wp::array_t<wp::int32> keep;
};


template <bool wp_linear_contiguous>
static void drop_contradicted_ff9c363c_cpu_kernel_forward(
    wp::launch_bounds_t<1> dim,
    size_t task_index,
    wp_args_drop_contradicted_ff9c363c *_wp_args)
{
    static constexpr bool wp_linear_tid = wp_linear_contiguous;

    //---------
    // argument vars
    wp::int32 var_current = _wp_args->current;
    wp::float32 var_margin = _wp_args->margin;
    wp::float32 var_step = _wp_args->step;
    wp::mat_t<4, 4, wp::float32> var_T_camera_world = _wp_args->T_camera_world;
    wp::vec_t<2, wp::float32> var_focal = _wp_args->focal;
    wp::vec_t<2, wp::float32> var_center = _wp_args->center;
    wp::array_t<wp::uint16> var_depth_images = _wp_args->depth_images;
    wp::array_t<wp::float32> var_depth_scales = _wp_args->depth_scales;
    wp::array_t<wp::int32> var_frame = _wp_args->frame;
    wp::array_t<wp::vec_t<3, wp::float32>> var_origin = _wp_args->origin;
    wp::array_t<wp::vec_t<3, wp::float32>> var_direction = _wp_args->direction;
    wp::array_t<wp::float32> var_depth = _wp_args->depth;
    wp::array_t<wp::int32> var_keep = _wp_args->keep;
    //---------
    // primal vars
    wp::int32 var_0;
    bool var_1;
    wp::int32* var_2;
    const wp::int32 var_3 = 0;
    bool var_4;
    wp::int32 var_5;
    wp::int32* var_6;
    bool var_7;
    wp::int32 var_8;
    wp::float32* var_9;
    const wp::float32 var_10 = 0.0;
    bool var_11;
    wp::float32 var_12;
    wp::vec_t<3, wp::float32>* var_13;
    wp::vec_t<3, wp::float32> var_14;
    wp::vec_t<3, wp::float32> var_15;
    wp::float32* var_16;
    wp::float32 var_17;
    wp::float32 var_18;
    wp::int32 var_19;
    const wp::int32 var_20 = 1;
    wp::int32 var_21;
    wp::range_t var_22;
    wp::int32 var_23;
    wp::float32* var_24;
    const wp::int32 var_25 = 1;
    wp::int32 var_26;
    wp::float32 var_27;
    wp::float32 var_28;
    wp::float32 var_29;
    wp::float32 var_30;
    wp::float32 var_31;
    wp::vec_t<3, wp::float32>* var_32;
    wp::vec_t<3, wp::float32> var_33;
    wp::vec_t<3, wp::float32> var_34;
    wp::vec_t<3, wp::float32> var_35;
    wp::vec_t<3, wp::float32> var_36;
    const wp::int32 var_37 = 2;
    wp::float32 var_38;
    const wp::float32 var_39 = 0.0;
    bool var_40;
    const wp::int32 var_41 = 0;
    wp::float32 var_42;
    const wp::int32 var_43 = 0;
    wp::float32 var_44;
    wp::float32 var_45;
    const wp::int32 var_46 = 2;
    wp::float32 var_47;
    wp::float32 var_48;
    const wp::int32 var_49 = 0;
    wp::float32 var_50;
    wp::float32 var_51;
    wp::float32 var_52;
    wp::int32 var_53;
    const wp::int32 var_54 = 1;
    wp::float32 var_55;
    const wp::int32 var_56 = 1;
    wp::float32 var_57;
    wp::float32 var_58;
    const wp::int32 var_59 = 2;
    wp::float32 var_60;
    wp::float32 var_61;
    const wp::int32 var_62 = 1;
    wp::float32 var_63;
    wp::float32 var_64;
    wp::float32 var_65;
    wp::int32 var_66;
    const wp::int32 var_67 = 0;
    const wp::int32 var_68 = 0;
    wp::float32* var_69;
    wp::vec_t<2, wp::float32> var_70;
    wp::float32 var_71;
    const wp::int32 var_72 = 0;
    wp::float32 var_73;
    const wp::float32 var_74 = 0.0;
    bool var_75;
    const wp::int32 var_76 = 1;
    wp::int32 var_77;
    bool var_78;
    const wp::int32 var_79 = 2;
    wp::float32 var_80;
    const wp::int32 var_81 = 0;
    wp::float32 var_82;
    wp::float32 var_83;
    bool var_84;
    const wp::int32 var_85 = 0;
    wp::float32* var_86;
    wp::float32 var_87;
    wp::float32 var_88;
    bool var_89;
    bool var_90;
    const wp::int32 var_91 = 2;
    wp::float32 var_92;
    const wp::int32 var_93 = 1;
    wp::float32 var_94;
    const wp::float32 var_95 = 0.5;
    wp::float32 var_96;
    wp::float32 var_97;
    bool var_98;
    const wp::int32 var_99 = 2;
    wp::float32 var_100;
    const wp::int32 var_101 = 0;
    wp::float32 var_102;
    const wp::float32 var_103 = 1.5;
    wp::float32 var_104;
    wp::float32 var_105;
    bool var_106;
    const wp::int32 var_107 = 0;
    //---------
    // forward
    // def drop_contradicted(                                                                 <L 156>
    // tid = wp.tid()                                                                         <L 177>
    var_0 = builtin_tid1d();
    // if keep[tid] == 0 or frame[tid] == current or depth[tid] <= 0.0:                       <L 178>
    var_2 = wp::address(var_keep, var_0);
    var_5 = wp::load(var_2);
    var_4 = (var_5 == var_3);
    var_1 = var_4;
    if (!var_1) {
        var_6 = wp::address(var_frame, var_0);
        var_8 = wp::load(var_6);
        var_7 = (var_8 == var_current);
        var_1 = var_1 || var_7;
    }
    if (!var_1) {
        var_9 = wp::address(var_depth, var_0);
        var_12 = wp::load(var_9);
        var_11 = (var_12 <= var_10);
        var_1 = var_1 || var_11;
    }
    if (var_1) {
        // return                                                                             <L 179>
        return;
    }
    // d = direction[tid]                                                                     <L 180>
    var_13 = wp::address(var_direction, var_0);
    var_15 = wp::load(var_13);
    var_14 = wp::copy(var_15);
    // count = int(depth[tid] / step) + 1                                                     <L 181>
    var_16 = wp::address(var_depth, var_0);
    var_18 = wp::load(var_16);
    var_17 = wp::div(var_18, var_step);
    var_19 = wp::int(var_17);
    var_21 = wp::add(var_19, var_20);
    // for n in range(count):                                                                 <L 182>
    var_22 = wp::range(var_21);
    start_for_1:;
        if (iter_cmp(var_22) == 0) goto end_for_1;
        var_23 = wp::iter_next(var_22);
        // z = depth[tid] * float(n + 1) / float(count)                                       <L 184>
        var_24 = wp::address(var_depth, var_0);
        var_26 = wp::add(var_23, var_25);
        var_27 = wp::float(var_26);
        var_29 = wp::load(var_24);
        var_28 = wp::mul(var_29, var_27);
        var_30 = wp::float(var_21);
        var_31 = wp::div(var_28, var_30);
        // q = wp.transform_point(T_camera_world, origin[tid] + z * d)                        <L 185>
        var_32 = wp::address(var_origin, var_0);
        var_33 = wp::mul(var_31, var_14);
        var_35 = wp::load(var_32);
        var_34 = wp::add(var_35, var_33);
        var_36 = wp::transform_point(var_T_camera_world, var_34);
        // if q[2] > 0.0:                                                                     <L 186>
        var_38 = wp::extract(var_36, var_37);
        var_40 = (var_38 > var_39);
        if (var_40) {
            // u = int(wp.rint(focal[0] * q[0] / q[2] + center[0]))                           <L 187>
            var_42 = wp::extract(var_focal, var_41);
            var_44 = wp::extract(var_36, var_43);
            var_45 = wp::mul(var_42, var_44);
            var_47 = wp::extract(var_36, var_46);
            var_48 = wp::div(var_45, var_47);
            var_50 = wp::extract(var_center, var_49);
            var_51 = wp::add(var_48, var_50);
            var_52 = wp::rint(var_51);
            var_53 = wp::int(var_52);
            // v = int(wp.rint(focal[1] * q[1] / q[2] + center[1]))                           <L 188>
            var_55 = wp::extract(var_focal, var_54);
            var_57 = wp::extract(var_36, var_56);
            var_58 = wp::mul(var_55, var_57);
            var_60 = wp::extract(var_36, var_59);
            var_61 = wp::div(var_58, var_60);
            var_63 = wp::extract(var_center, var_62);
            var_64 = wp::add(var_61, var_63);
            var_65 = wp::rint(var_64);
            var_66 = wp::int(var_65);
            // seen = nearest_and_farthest(depth_images, 0, depth_scales[0], u, v)            <L 189>
            var_69 = wp::address(var_depth_scales, var_68);
            var_71 = wp::load(var_69);
            var_70 = nearest_and_farthest_0(var_depth_images, var_67, var_71, var_53, var_66);
            // if seen[0] > 0.0:                                                              <L 190>
            var_73 = wp::extract(var_70, var_72);
            var_75 = (var_73 > var_74);
            if (var_75) {
                // if n + 1 == count:                                                         <L 191>
                var_77 = wp::add(var_23, var_76);
                var_78 = (var_77 == var_21);
                if (var_78) {
                    // if q[2] < seen[0] - margin:                                            <L 192>
                    var_80 = wp::extract(var_36, var_79);
                    var_82 = wp::extract(var_70, var_81);
                    var_83 = wp::sub(var_82, var_margin);
                    var_84 = (var_80 < var_83);
                    if (var_84) {
                        // keep[tid] = 0                                                      <L 193>
                        wp::array_store(var_keep, var_0, var_85);
                    }
                }
                if (!var_78) {
                    // elif z < depth[tid] - margin:                                          <L 194>
                    var_86 = wp::address(var_depth, var_0);
                    var_88 = wp::load(var_86);
                    var_87 = wp::sub(var_88, var_margin);
                    var_89 = (var_31 < var_87);
                    if (var_89) {
                        // if q[2] > seen[1] + 0.5 * margin and q[2] < seen[0] + 1.5 * margin:       <L 195>
                        var_92 = wp::extract(var_36, var_91);
                        var_94 = wp::extract(var_70, var_93);
                        var_96 = wp::mul(var_95, var_margin);
                        var_97 = wp::add(var_94, var_96);
                        var_98 = (var_92 > var_97);
                        var_90 = var_98;
                        if (var_90) {
                            var_100 = wp::extract(var_36, var_99);
                            var_102 = wp::extract(var_70, var_101);
                            var_104 = wp::mul(var_103, var_margin);
                            var_105 = wp::add(var_102, var_104);
                            var_106 = (var_100 < var_105);
                            var_90 = var_90 && var_106;
                        }
                        if (var_90) {
                            // keep[tid] = 0                                                  <L 196>
                            wp::array_store(var_keep, var_0, var_107);
                        }
                    }
                }
            }
        }
        goto start_for_1;
    end_for_1:;
}



template <bool wp_linear_contiguous>
static WP_FORCEINLINE void drop_contradicted_ff9c363c_cpu_forward_tasks(
    wp::launch_bounds_t<1> *dim,
    wp_args_drop_contradicted_ff9c363c *_wp_args)
{
    for (size_t task_index = 0; task_index < dim->size; ++task_index)
    {
        drop_contradicted_ff9c363c_cpu_kernel_forward<wp_linear_contiguous>(*dim, task_index, _wp_args);
    }
}

static WP_FORCEINLINE void drop_contradicted_ff9c363c_cpu_forward_dispatch(
    wp::launch_bounds_t<1> *dim,
    wp_args_drop_contradicted_ff9c363c *_wp_args)
{
    wp::tile_shared_storage_t tile_mem;
#if defined(WP_ENABLE_TILES_IN_STACK_MEMORY)
    wp::shared_tile_storage = &tile_mem;
#endif

    drop_contradicted_ff9c363c_cpu_forward_tasks<false>(dim, _wp_args);
}

extern "C" {

// Python CPU entry points
WP_API void drop_contradicted_ff9c363c_cpu_forward(
    wp::launch_bounds_t<1> *dim,
    wp_args_drop_contradicted_ff9c363c *_wp_args)
{
    drop_contradicted_ff9c363c_cpu_forward_dispatch(dim, _wp_args);
}

} // extern C

