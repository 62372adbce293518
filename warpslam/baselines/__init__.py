"""Other methods under the interface of `warpslam.slam.Slam`, to compare with: iMAP* and TSDF fusion."""
