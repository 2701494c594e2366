// The viewer's controls: one column beside the picture, from what is looked at most to what is
// looked at least.
#include <fmt/format.h>

#include "client/camera_control.h"
#include "client/viewer.h"
#include "common/false_colour.h"

namespace tessera {
namespace {

constexpr float label_width = 96;

template <class... Args>
void text(fmt::format_string<Args...> format, Args&&... args) {
    ImGui::TextUnformatted(fmt::format(format, std::forward<Args>(args)...).c_str());
}

template <class... Args>
void quiet(fmt::format_string<Args...> format, Args&&... args) {
    ImGui::TextDisabled("%s", fmt::format(format, std::forward<Args>(args)...).c_str());
}

/// A quiet name, and its value in a column.
template <class... Args>
void row(const char* name, fmt::format_string<Args...> format, Args&&... args) {
    ImGui::TextDisabled("%s", name);
    ImGui::SameLine(label_width);
    text(format, std::forward<Args>(args)...);
}

/// Before a control: its name in front of it rather than behind.
std::string labelled(const char* name) {
    ImGui::AlignTextToFramePadding();
    ImGui::TextDisabled("%s", name);
    ImGui::SameLine(label_width);
    ImGui::SetNextItemWidth(-1);
    return std::string("##") + name;
}

bool section(const char* name, bool open = true) {
    ImGui::Spacing();
    ImGui::PushStyleColor(ImGuiCol_Header, ImVec4(0, 0, 0, 0));
    const bool shown = ImGui::CollapsingHeader(name, open ? ImGuiTreeNodeFlags_DefaultOpen : 0);
    ImGui::PopStyleColor();
    return shown;
}

void plot(const char* name, const std::vector<float>& values, const std::string& now) {
    ImGui::AlignTextToFramePadding();
    ImGui::TextDisabled("%s", name);
    ImGui::SameLine(label_width);
    const float most = values.empty() ? 1 : *std::max_element(values.begin(), values.end());
    const std::string id = std::string("##plot ") + name;
    ImGui::PlotLines(id.c_str(), values.data(), int(values.size()), 0, nullptr, 0, 1.2f * most,
                     {130, 30});
    ImGui::SameLine();
    text("{}", now);
}

bool edit_colour(const char* name, vec3& value) {
    return ImGui::ColorEdit3(labelled(name).c_str(), &value.x,
                             ImGuiColorEditFlags_Float | ImGuiColorEditFlags_NoInputs);
}

bool edit_number(const char* name, float& value, float low, float high) {
    return ImGui::SliderFloat(labelled(name).c_str(), &value, low, high, "%.2f",
                              ImGuiSliderFlags_AlwaysClamp);
}

/// A light as a colour and how strong it is.
bool edit_light(const char* colour_name, const char* strength_name, vec3& value) {
    const float strength = max_component(value);
    vec3 colour = strength > 0 ? value / strength : vec3(1);
    float stronger = strength;
    bool changed = edit_colour(colour_name, colour);
    changed |= ImGui::DragFloat(labelled(strength_name).c_str(), &stronger,
                                std::max(0.01f * strength, 0.01f), 0, 1e6f, "%.2f",
                                ImGuiSliderFlags_AlwaysClamp);
    value = stronger * colour;
    return changed;
}

constexpr std::pair<Channel, const char*> channels[] = {{Channel::radiance, "Picture"},
                                                        {Channel::direct, "Direct light"},
                                                        {Channel::indirect, "Indirect light"},
                                                        {Channel::irradiance, "Irradiance"},
                                                        {Channel::albedo, "Albedo"},
                                                        {Channel::normal, "Normal"},
                                                        {Channel::depth, "Depth"},
                                                        {Channel::path_length, "Path length"},
                                                        {Channel::error, "Error"},
                                                        {Channel::owner, "Tile owner"}};

ImVec2 at(const vec2& p) { return {p.x, p.y}; }
ImU32 orange(int alpha) { return IM_COL32(237, 158, 71, alpha); }
ImU32 colour(const Rgb8& rgb) { return IM_COL32(rgb[0], rgb[1], rgb[2], 255); }

const char* name_of(Channel channel) {
    for (const auto& [value, name] : channels)
        if (value == channel) return name;
    return "";
}

}  // namespace

void Viewer::draw_controls() {
    draw_selected_box();
    draw_light_marks();
    draw_gizmo();
    draw_legend();
    if (memory_.panel) draw_panel();
    if (help_) draw_help();
    draw_notice();
}

void Viewer::draw_panel() {
    const ImGuiIO& io = ImGui::GetIO();
    ImGui::SetNextWindowPos({io.DisplaySize.x - panel_width, 0});
    ImGui::SetNextWindowSize({panel_width, io.DisplaySize.y});
    ImGui::Begin("panel", nullptr,
                 ImGuiWindowFlags_NoTitleBar | ImGuiWindowFlags_NoResize | ImGuiWindowFlags_NoMove);
    text("{}", config_.scene);
    ImGui::SameLine();
    quiet("version {}", client_.scene().version);
    draw_statistics();
    draw_motion();
    draw_display();
    draw_selection();
    draw_lights();
    draw_cameras();
    draw_workers();
    ImGui::Spacing();
    if (ImGui::Button(recorder_ ? "end the recording" : "record this session")) toggle_recording();
    quiet("H help    Tab panel    P save picture");
    ImGui::End();
}

void Viewer::draw_statistics() {
    if (!picture_) return quiet("waiting for the first picture ...");
    const ViewPicture& about = picture_->about;
    const std::uint32_t passes = config_.settings.passes;
    ImGui::ProgressBar(float(about.passes) / float(passes), {-1, 4}, "");
    row("picture", "{} x {}, {}", picture_->size.width, picture_->size.height,
        about.settled ? "settled" : fmt::format("pass {} of {}", about.passes, passes));
    if (about.render_seconds > 0)
        row("speed", "{:.1f} passes/s, {:.1f} Mrays/s", about.passes / about.render_seconds,
            1e-6 * double(about.rays) / about.render_seconds);
    plot("first pass", first_.values, fmt::format("{:.0f} ms", first_.newest()));
    plot("latency", latency_.values, fmt::format("{:.0f} ms", latency_.newest()));
    plot("error", error_.values, fmt::format("{:.4f}", error_.newest()));
}

void Viewer::draw_motion() {
    if (player_.duration() <= 0 || !section("Motion")) return;
    if (ImGui::Button(player_.playing() ? "pause" : "play", {label_width - 24, 0}))
        player_.play(!player_.playing());
    ImGui::SameLine(label_width);
    ImGui::SetNextItemWidth(-1);
    auto seconds = float(player_.seconds());
    if (ImGui::SliderFloat("##seconds", &seconds, 0, float(player_.duration()), "%.2f s"))
        player_.seek(double(seconds));
}

void Viewer::draw_display() {
    if (!section("Display")) return;
    if (ImGui::BeginCombo(labelled("show").c_str(), name_of(shown_))) {
        for (const auto& [channel, name] : channels)
            if (ImGui::Selectable(name, shown_ == channel)) shown_ = channel;
        ImGui::EndCombo();
    }
    edit_number("exposure", memory_.tone_map.exposure, -8, 8);
    bool filmic = memory_.tone_map.curve == ToneCurve::filmic;
    const std::string curve = labelled("tone");
    if (ImGui::RadioButton("filmic", filmic)) filmic = true;
    ImGui::SameLine();
    if (ImGui::RadioButton("plain sRGB", !filmic)) filmic = false;
    memory_.tone_map.curve = filmic ? ToneCurve::filmic : ToneCurve::srgb;
    constexpr const char* sizes[] = {"as is quick", "full", "half", "a third", "a quarter"};
    ImGui::Combo(labelled("size").c_str(), &divisor_, sizes, std::size(sizes));
    bool path = config_.settings.integrator == Integrator::path;
    labelled("light");
    if (ImGui::RadioButton("interactive", !path)) path = false;
    ImGui::SameLine();
    if (ImGui::RadioButton("reference", path)) path = true;
    config_.settings.integrator = path ? Integrator::path : Integrator::igi;
}

void Viewer::draw_selection() {
    if (!section("Selection")) return;
    if (const Light* light = selected_light()) return draw_light(*light);
    const Instance* instance = selected();
    if (!instance) return quiet("click an object or a light; drag it, or an arrow");
    text("{}", instance->name);
    vec3 at(instance->world_from_object[3]);
    if (ImGui::DragFloat3(labelled("place").c_str(), &at.x, 0.01f, 0, 0, "%.2f"))
        edit(moved(*instance, at));
    const Object& object = scene().objects[instance->object];
    if (ImGui::BeginCombo(labelled("material").c_str(), material_.c_str())) {
        for (const std::uint32_t m : object.materials) {
            const std::string& name = scene().materials[m].name;
            if (ImGui::Selectable(name.c_str(), material_ == name)) material_ = name;
        }
        ImGui::EndCombo();
    }
    for (const std::uint32_t m : object.materials)
        if (scene().materials[m].name == material_) return draw_material(scene().materials[m]);
}

/// The edges of the selection's bounds, over the picture.
void Viewer::draw_selected_box() {
    const Instance* instance = selected();
    if (!instance || !picker_) return;
    const Box box = picker_->bounds(scene(), *instance);
    const auto corner = [&](int i) {
        return window_point({i & 1 ? box.hi.x : box.lo.x, i & 2 ? box.hi.y : box.lo.y,
                             i & 4 ? box.hi.z : box.lo.z});
    };
    for (int i = 0; i < 8; ++i)
        for (int axis = 1; axis <= 4; axis *= 2)
            if (const auto a = corner(i), b = corner(i | axis); !(i & axis) && a && b)
                ImGui::GetBackgroundDrawList()->AddLine(at(*a), at(*b), orange(150));
}

/// A small sun where there is a light that has no shape.
void Viewer::draw_light_marks() {
    ImDrawList* const list = ImGui::GetBackgroundDrawList();
    for (const Light& light : scene().lights) {
        const auto place = window_point(light.position);
        if (light.kind == LightKind::directional || !place) continue;
        const ImU32 ink =
            light.name == selected_light_ ? orange(255) : IM_COL32(255, 240, 200, 200);
        list->AddCircleFilled(at(*place), 4, ink);
        for (int ray = 0; ray < 8; ++ray) {
            const float angle = float(ray) * pi / 4;
            const vec2 direction(std::cos(angle), std::sin(angle));
            list->AddLine(at(*place + 7.0f * direction), at(*place + 11.0f * direction), ink, 1.5f);
        }
    }
}

/// Arrows to draw the selection along.
void Viewer::draw_gizmo() {
    constexpr ImU32 inks[] = {IM_COL32(226, 88, 80, 255), IM_COL32(120, 190, 90, 255),
                              IM_COL32(90, 140, 230, 255)};
    constexpr float head = 11, half_head = 5;
    const auto arrows = gizmo();
    const auto base = arrows ? window_point(arrows->origin) : std::nullopt;
    if (!base) return;
    for (int i = 0; i < 3; ++i) {
        const auto tip = window_point(arrows->tip(i));
        if (!tip || length(*tip - *base) < head) continue;
        const vec2 along = normalize(*tip - *base), across(-along.y, along.x);
        const vec2 neck = *tip - head * along;
        ImDrawList* const list = ImGui::GetBackgroundDrawList();
        list->AddLine(at(*base), at(neck), inks[i], 2.5f);
        list->AddTriangleFilled(at(*tip), at(neck + half_head * across),
                                at(neck - half_head * across), inks[i]);
    }
}

void Viewer::draw_material(const Material& material) {
    Material next = material;
    SetMaterial change{.material = material.name};
    if (edit_colour("colour", next.base_color)) change.base_color = next.base_color;
    if (edit_number("roughness", next.roughness, 0, 1)) change.roughness = next.roughness;
    if (edit_number("metallic", next.metallic, 0, 1)) change.metallic = next.metallic;
    if (edit_light("glow", "radiance", next.emission)) change.emission = next.emission;
    if (change != SetMaterial{.material = material.name}) edit(change);
}

void Viewer::draw_light(const Light& light) {
    ImGui::PushID(light.name.c_str());
    text("{}", light.name);
    SetLight change{.light = light.name};
    vec3 intensity = light.intensity, position = light.position;
    if (edit_light("colour", "intensity", intensity)) change.intensity = intensity;
    if (light.kind != LightKind::directional &&
        ImGui::DragFloat3(labelled("place").c_str(), &position.x, 0.02f, 0, 0, "%.2f"))
        change.position = position;
    if (change != SetLight{.light = light.name}) edit(change);
    ImGui::PopID();
}

/// Light from all sides; a picture of it stays.
void Viewer::draw_environment() {
    ImGui::PushID("environment");
    text("environment");
    vec3 radiance = scene().environment.radiance;
    if (edit_light("colour", "radiance", radiance)) edit(SetEnvironment{.radiance = radiance});
    ImGui::PopID();
}

void Viewer::draw_lights() {
    if (!section("Lights", false)) return;
    for (const Light& light : scene().lights) draw_light(light);
    draw_environment();
    // Surfaces that emit are lights, too.
    for (const Material& material : scene().materials) {
        if (max_component(material.emission) <= 0) continue;
        ImGui::PushID(material.name.c_str());
        text("{}", material.name);
        vec3 emission = material.emission;
        if (edit_light("colour", "radiance", emission))
            edit(SetMaterial{.material = material.name, .emission = emission});
        ImGui::PopID();
    }
}

void Viewer::draw_cameras() {
    if (!section("Camera", false)) return;
    ImGui::DragFloat3(labelled("eye").c_str(), &camera_.eye.x, 0.01f, 0, 0, "%.2f");
    ImGui::DragFloat3(labelled("looks at").c_str(), &camera_.at.x, 0.01f, 0, 0, "%.2f");
    edit_number("opening", camera_.fov_y, 5, 120);
    for (const Camera& camera : scene().cameras)
        if (ImGui::Button(camera.name.c_str())) change_camera(camera);
    if (ImGui::Button("keep as a camera of the scene")) {
        Camera kept = camera_;
        kept.name = fmt::format("view {}", scene().cameras.size() + 1);
        edit(SetCamera{kept});
    }
}

void Viewer::draw_workers() {
    if (!section("Cluster", false) || !status_) return;
    row("server", "{} viewers, {} frames", status_->viewers, status_->frames_done);
    if (!ImGui::BeginTable("workers", 4, ImGuiTableFlags_SizingStretchProp)) return;
    for (const char* title : {"worker", "threads", "Mtiles", "ms away"}) {
        ImGui::TableNextColumn();
        quiet("{}", title);
    }
    for (const WorkerStatus& worker : status_->workers) {
        ImGui::TableNextColumn();
        text("{}", worker.name);
        ImGui::TableNextColumn();
        text("{}", worker.threads);
        ImGui::TableNextColumn();
        text("{:.3f}", 1e-6 * double(worker.tiles));
        ImGui::TableNextColumn();
        text("{:.1f}", 1e3 * worker.round_trip_seconds);
    }
    ImGui::EndTable();
}

/// What the colours of the channel shown mean.
void Viewer::draw_legend() {
    const std::vector<LegendMark> marks = legend_of(shown_);
    const bool owners = shown_ == Channel::owner && status_;
    if (marks.empty() && !owners) return;
    constexpr float width = 260, height = 12;
    ImGui::SetNextWindowPos({24, 24});
    ImGui::Begin("legend", nullptr,
                 ImGuiWindowFlags_NoTitleBar | ImGuiWindowFlags_AlwaysAutoResize |
                     ImGuiWindowFlags_NoInputs);
    text("{}", name_of(shown_));
    if (owners)
        for (const WorkerStatus& worker : status_->workers) {
            ImGui::TextColored(ImColor(colour(colour_of_number(worker.peer))), "##");
            ImGui::SameLine();
            text("{}", worker.name);
        }
    if (!marks.empty()) {
        const ImVec2 at = ImGui::GetCursorScreenPos();
        for (int i = 0; i < int(width); ++i)
            ImGui::GetWindowDrawList()->AddRectFilled({at.x + float(i), at.y},
                                                      {at.x + float(i + 1), at.y + height},
                                                      colour(viridis((float(i) + 0.5f) / width)));
        for (const LegendMark& mark : marks) {
            const float half = 0.5f * ImGui::CalcTextSize(mark.text.c_str()).x;
            const float x = std::clamp(width * mark.position - half, 0.0f, width - 2 * half);
            ImGui::GetWindowDrawList()->AddText({at.x + x, at.y + height + 2},
                                                IM_COL32(210, 210, 210, 255), mark.text.c_str());
        }
        ImGui::Dummy({width, height + ImGui::GetTextLineHeight() + 4});
    }
    ImGui::End();
}

void Viewer::draw_help() {
    constexpr std::pair<const char*, const char*> lines[] = {
        {"drag", "turn around what is looked at"},
        {"right drag", "look around"},
        {"middle or Shift drag", "pan"},
        {"wheel", "nearer, farther"},
        {"W A S D  Q E", "fly; Shift: faster"},
        {"click", "select an object or a light"},
        {"drag what is selected", "move it in its ground plane; by an arrow, along that"},
        {"Delete", "remove it"},
        {"Space", "play or pause what moves"},
        {"Home", "back to where it began"},
        {"P or F12", "save the picture"},
        {"R", "record what is looked at and changed, and end that"},
        {"Tab", "hide or show the panel"},
        {"H or F1", "this help"}};
    ImGui::SetNextWindowPos({24, 24});
    ImGui::Begin(
        "help", nullptr,
        ImGuiWindowFlags_NoTitleBar | ImGuiWindowFlags_AlwaysAutoResize | ImGuiWindowFlags_NoMove);
    for (const auto& [keys, what] : lines) {
        ImGui::TextUnformatted(keys);
        ImGui::SameLine(190);
        quiet("{}", what);
    }
    ImGui::End();
}

void Viewer::draw_notice() {
    if (Clock::now() > notice_until_) return;
    ImGui::SetNextWindowPos({24, ImGui::GetIO().DisplaySize.y - 24}, 0, {0, 1});
    ImGui::Begin(
        "notice", nullptr,
        ImGuiWindowFlags_NoTitleBar | ImGuiWindowFlags_AlwaysAutoResize | ImGuiWindowFlags_NoMove);
    text("{}", notice_);
    ImGui::End();
}

}  // namespace tessera
