"""The paper's studies on sequences that one has: `warpslam bench`.

A suite (`warpslam.bench.suite`) names sequences and studies (`warpslam.bench.studies`); together they become jobs of a
batch (`warpslam.bench.jobs`), whose run folders are read (`warpslam.bench.figures`), summed up over seeds
(`warpslam.bench.results`) and written as tables, plots and a page.
"""
