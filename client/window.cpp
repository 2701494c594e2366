#include "client/window.h"

#include <backends/imgui_impl_sdl.h>
#include <fmt/format.h>

#include <filesystem>

#include "common/check.h"

namespace tessera {
namespace {

constexpr float font_pixels = 15;
constexpr const char* font_file = "/usr/share/fonts/truetype/dejavu/DejaVuSans.ttf";

template <class T>
T* must(T* made, const char* what) {
    if (!made)
        throw UserError(fmt::format(
            "{}: {}; the viewer needs a screen (set DISPLAY, or SDL_VIDEODRIVER=dummy for none)",
            what, SDL_GetError()));
    return made;
}

SDL_Window* open_window(const WindowConfig& config) {
    if (SDL_Init(SDL_INIT_VIDEO) != 0) must<SDL_Window>(nullptr, "cannot open a window");
    return must(SDL_CreateWindow(config.title.c_str(), config.x, config.y, config.size.width,
                                 config.size.height, SDL_WINDOW_RESIZABLE),
                "cannot open a window");
}

SDL_Renderer* open_renderer(SDL_Window* window) {
    SDL_SetHint(SDL_HINT_RENDER_SCALE_QUALITY, "linear");
    SDL_Renderer* renderer = SDL_CreateRenderer(window, -1, SDL_RENDERER_PRESENTVSYNC);
    if (!renderer) renderer = SDL_CreateRenderer(window, -1, SDL_RENDERER_SOFTWARE);
    return must(renderer, "cannot draw");
}

/// Calm and dark, one accent.
void style_controls() {
    ImGui::StyleColorsDark();
    ImGuiStyle& style = ImGui::GetStyle();
    style.WindowRounding = style.ChildRounding = 0;
    style.FrameRounding = style.GrabRounding = style.PopupRounding = 4;
    style.WindowBorderSize = style.FrameBorderSize = 0;
    style.WindowPadding = {14, 12};
    style.ItemSpacing = {8, 7};
    style.FramePadding = {8, 4};
    style.ScrollbarSize = 10;
    const ImVec4 accent(0.93f, 0.62f, 0.28f, 1), quiet(0.19f, 0.20f, 0.22f, 1);
    ImVec4* colours = style.Colors;
    colours[ImGuiCol_Text] = {0.88f, 0.88f, 0.86f, 1};
    colours[ImGuiCol_TextDisabled] = {0.56f, 0.57f, 0.58f, 1};
    colours[ImGuiCol_WindowBg] = {0.105f, 0.11f, 0.12f, 0.97f};
    colours[ImGuiCol_PopupBg] = {0.12f, 0.125f, 0.135f, 1};
    colours[ImGuiCol_Separator] = {0.22f, 0.23f, 0.25f, 1};
    for (const ImGuiCol c : {ImGuiCol_FrameBg, ImGuiCol_Button, ImGuiCol_Header})
        colours[c] = quiet;
    for (const ImGuiCol c :
         {ImGuiCol_FrameBgHovered, ImGuiCol_ButtonHovered, ImGuiCol_HeaderHovered})
        colours[c] = {0.25f, 0.26f, 0.285f, 1};
    for (const ImGuiCol c : {ImGuiCol_FrameBgActive, ImGuiCol_ButtonActive, ImGuiCol_HeaderActive})
        colours[c] = {0.30f, 0.31f, 0.33f, 1};
    for (const ImGuiCol c : {ImGuiCol_SliderGrab, ImGuiCol_SliderGrabActive, ImGuiCol_CheckMark,
                             ImGuiCol_PlotLines, ImGuiCol_PlotHistogram})
        colours[c] = accent;
}

void start_controls(SDL_Window* window) {
    ImGui::CreateContext();
    ImGui::GetIO().IniFilename = nullptr;
    style_controls();
    if (std::filesystem::exists(font_file))
        ImGui::GetIO().Fonts->AddFontFromFileTTF(font_file, font_pixels);
    ImGui::GetIO().BackendFlags |= ImGuiBackendFlags_RendererHasVtxOffset;
    ImGui_ImplSDL2_InitForSDLRenderer(window);
}

SDL_Texture* font_texture(SDL_Renderer* renderer) {
    unsigned char* pixels = nullptr;
    int width = 0, height = 0;
    ImGui::GetIO().Fonts->GetTexDataAsRGBA32(&pixels, &width, &height);
    SDL_Texture* texture = must(SDL_CreateTexture(renderer, SDL_PIXELFORMAT_ABGR8888,
                                                  SDL_TEXTUREACCESS_STATIC, width, height),
                                "cannot draw");
    SDL_UpdateTexture(texture, nullptr, pixels, 4 * width);
    SDL_SetTextureBlendMode(texture, SDL_BLENDMODE_BLEND);
    ImGui::GetIO().Fonts->SetTexID(texture);
    return texture;
}

}  // namespace

Window::Window(const WindowConfig& config)
    : window_(open_window(config), SDL_DestroyWindow),
      renderer_(open_renderer(window_.get()), SDL_DestroyRenderer),
      font_(nullptr, SDL_DestroyTexture),
      picture_(nullptr, SDL_DestroyTexture) {
    start_controls(window_.get());
    font_.reset(font_texture(renderer_.get()));
}

Window::~Window() {
    ImGui_ImplSDL2_Shutdown();
    ImGui::DestroyContext();
    picture_.reset();
    font_.reset();
    renderer_.reset();
    window_.reset();
    SDL_Quit();
}

bool Window::poll_events(const std::function<void(const SDL_Event&)>& handle) {
    bool any = false;
    for (SDL_Event event; SDL_PollEvent(&event); any = true) {
        ImGui_ImplSDL2_ProcessEvent(&event);
        handle(event);
    }
    return any;
}

void Window::set_picture(std::span<const std::uint8_t> rgb, ImageSize size) {
    CHECK_EQ(rgb.size(), 3 * size.pixels());
    if (!picture_ || size != picture_size_)
        picture_.reset(must(SDL_CreateTexture(renderer_.get(), SDL_PIXELFORMAT_RGB24,
                                              SDL_TEXTUREACCESS_STREAMING, size.width, size.height),
                            "cannot draw"));
    picture_size_ = size;
    SDL_UpdateTexture(picture_.get(), nullptr, rgb.data(), 3 * size.width);
}

void Window::draw(const SDL_Rect& area, const std::function<void()>& controls) {
    ImGui_ImplSDL2_NewFrame();
    ImGui::NewFrame();
    controls();
    ImGui::Render();
    SDL_SetRenderDrawColor(renderer_.get(), 18, 19, 21, 255);
    SDL_RenderClear(renderer_.get());
    if (picture_) SDL_RenderCopy(renderer_.get(), picture_.get(), nullptr, &area);
    draw_controls();
    SDL_RenderPresent(renderer_.get());
}

/// Draws ImGui's triangles.
void Window::draw_controls() {
    const ImDrawData& data = *ImGui::GetDrawData();
    for (int l = 0; l < data.CmdListsCount; ++l) {
        const ImDrawList& list = *data.CmdLists[l];
        for (const ImDrawCmd& command : list.CmdBuffer) {
            const ImVec4& c = command.ClipRect;
            const SDL_Rect clip{int(c.x), int(c.y), int(c.z - c.x), int(c.w - c.y)};
            SDL_RenderSetClipRect(renderer_.get(), &clip);
            const ImDrawVert* v = list.VtxBuffer.Data + command.VtxOffset;
            SDL_RenderGeometryRaw(
                renderer_.get(), static_cast<SDL_Texture*>(command.TextureId), &v->pos.x,
                sizeof(ImDrawVert), reinterpret_cast<const SDL_Color*>(&v->col), sizeof(ImDrawVert),
                &v->uv.x, sizeof(ImDrawVert), list.VtxBuffer.Size - int(command.VtxOffset),
                list.IdxBuffer.Data + command.IdxOffset, int(command.ElemCount), sizeof(ImDrawIdx));
        }
    }
    SDL_RenderSetClipRect(renderer_.get(), nullptr);
}

WindowConfig Window::place() const {
    WindowConfig out;
    SDL_GetWindowPosition(window_.get(), &out.x, &out.y);
    out.size = size();
    return out;
}

ImageSize Window::size() const {
    ImageSize out;
    SDL_GetRendererOutputSize(renderer_.get(), &out.width, &out.height);
    return out;
}

std::vector<std::uint8_t> Window::pixels() {
    const ImageSize all = size();
    std::vector<std::uint8_t> out(3 * all.pixels());
    SDL_RenderReadPixels(renderer_.get(), nullptr, SDL_PIXELFORMAT_RGB24, out.data(),
                         3 * all.width);
    return out;
}

}  // namespace tessera
