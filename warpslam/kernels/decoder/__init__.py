"""The decoders (Sec. 3.1; the authors' released code): grid lookup, Fourier embedding and MLP, forward and adjoint.

Middle, fine and colour, with e = sin(p B) in R^93 and the looked-up feature c (32; fine: [fine, middle], 64):

    h = e;  for k = 0..4:  h = relu(W_k h + b_k) + V_k c + d_k;  after k = 2: h = [e, h]
    out = W_o h + b_o

Coarse has no embedding and no V_k:  h = c;  h = relu(W_k h + b_k);  after k = 2: h = [c, h].

A thread works on a block of samples, a `Block` of 4 x 32 on the CPU and of 1 x 32 on CUDA. A weight matrix is stored as
rows of `Vec32`, row k holding what input k adds to the 32 outputs, so that a layer is ``r += x[k] * W[k]``: it
vectorises over the outputs, and each row that is read serves all samples of the block. The weights of a decoder are
twice as large as a CPU's first cache; one sample at a time, the kernels wait for them and take 1.7 times as long. The
adjoint uses the same rows of the transposed matrices.

A forward launch for occupancy covers some samples of each ray, and leaves out blocks of rays whose transmittance is
spent. Colour and the adjoints work on lists of samples (`Listed`, see `warpslam.kernels.compositing`), so that blocks
are full although few samples of a ray count. Forward keeps one bit per ReLU (5 words a sample and decoder); the adjoint
kernels are written by hand, because the generated adjoint replays the forward and costs 4 to 16 times as much. They
return

    d_logit -> rows of the grid that have a place (`RowGradient`), the sample position (``point_grad``), and for the
    colour decoder the weights including B (`WeightGradient`).

As in the released code the middle feature that enters the fine decoder carries no gradient.

On CUDA, where thousands of samples are worked on at once, they would queue for the same rows of a gradient: each stores
its own, and `scatter_features` and `color_weights` sum them.

The kernels are built for the CPU and for CUDA, for dense rows and for rows in blocks, from one source:
`build.decoder_kernels`. All parts end in one Warp module each, so that they compile together.
"""
