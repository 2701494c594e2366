// tessera compare A B: error metrics between two pictures.

#include <fmt/format.h>

#include <nlohmann/json.hpp>

#include "client/commands.h"
#include "common/check.h"
#include "common/image_io.h"
#include "common/metrics.h"

namespace tessera {
namespace {

struct CompareOptions {
    std::string a, b;
    bool json = false;
};

void print_table(const Comparison& c) {
    fmt::print(
        "rmse          {:.6g}\n"
        "rmse_clamped  {:.6g}   both clamped to [0,1]\n"
        "relmse        {:.6g}\n"
        "delta_e       {:.6g}   mean, CIELAB 1976\n"
        "max_abs       {:.6g}\n"
        "mean_a        {:.6g}\n"
        "mean_b        {:.6g}   ratio a/b {:.5f}\n"
        "identical     {}\n",
        c.rmse, c.rmse_clamped, c.relmse, c.delta_e, c.max_abs, c.mean_a, c.mean_b,
        c.mean_a / c.mean_b, c.identical);
}

void print_json(const Comparison& c) {
    const nlohmann::json json = {{"rmse", c.rmse},       {"rmse_clamped", c.rmse_clamped},
                                 {"relmse", c.relmse},   {"delta_e", c.delta_e},
                                 {"max_abs", c.max_abs}, {"mean_a", c.mean_a},
                                 {"mean_b", c.mean_b},   {"identical", c.identical}};
    fmt::print("{}\n", json.dump(2));
}

void run(const CompareOptions& options) {
    const Image a = read_image(options.a);
    const Image b = read_image(options.b);
    if (a.size != b.size)
        throw UserError(
            fmt::format("{} is {}x{} and {} is {}x{}: only pictures of one size compare", options.a,
                        a.size.width, a.size.height, options.b, b.size.width, b.size.height));
    const Comparison comparison = compare(a, b);
    options.json ? print_json(comparison) : print_table(comparison);
}

}  // namespace

void add_compare_command(CLI::App& app) {
    auto options = std::make_shared<CompareOptions>();
    CLI::App* command = app.add_subcommand(
        "compare",
        "Error metrics between two pictures, in linear RGB (8-bit files are taken as sRGB)");
    command->add_option("A", options->a, "a picture")->required();
    command->add_option("B", options->b, "the picture it is compared with, the reference")
        ->required();
    command->add_flag("--json", options->json, "print JSON");
    command->callback([options] { run(*options); });
}

}  // namespace tessera
